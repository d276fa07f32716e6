"""The edge: REST (FastAPI) and gRPC in one process on one event loop. No torch, no engine, no worker.

A submission: rest.create_refinement or rpc.Refinements.CreateRefinement -> uploads.read_... -> uploads.submit
-> JobStore.submit.
"""
