"""The inputs of a run, judged before it: check.py finds, look.py draws."""
