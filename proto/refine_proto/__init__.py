"""The contract of REFINE as a service: models (their one meaning), errors, wire format and conversion.

`models` and `errors` need pydantic only; `convert` and `v1` need protobuf and grpcio.
"""
