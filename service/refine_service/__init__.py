"""The edge: REST (FastAPI) and gRPC in one process on one event loop. No torch, no engine, no worker.

A submission: rest.refinements.create_refinement or rpc.refinements.Refinements.CreateRefinement -> body
-> edge.submit -> JobStore.submit.
"""
