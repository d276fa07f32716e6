"""The contract over HTTP (FastAPI): one router a resource, problem details, one middleware around them."""
