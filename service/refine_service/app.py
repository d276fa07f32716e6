"""The REST application."""

from __future__ import annotations

from fastapi import FastAPI
from starlette.types import ASGIApp

from . import operations, rest, rest_artifacts, rest_events
from .edge import Edge
from .openapi import describe
from .problems import install_handlers
from .rest_calls import HttpCalls


def make_app(edge: Edge) -> ASGIApp:
    """Everything that HTTP offers, as one ASGI application."""
    app = FastAPI(
        title="REFINE",
        version="1",  # of the contract, as in the paths
        description="Refines a coarse mesh at test time from its silhouette and camera.",
    )
    app.state.edge = edge
    for module in (rest, rest_events, rest_artifacts, operations):
        app.include_router(module.router)
    install_handlers(app)
    app.openapi = describe(app)  # type: ignore[method-assign]
    return HttpCalls(app, edge.metrics)
