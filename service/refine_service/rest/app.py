"""The REST application."""

from __future__ import annotations

from fastapi import FastAPI
from starlette.types import ASGIApp

from ..edge.edge import Edge
from . import artifacts, cameras, events, health, page, refinements
from .middleware import HttpCalls
from .openapi import describe
from .origins import OwnPagesOnly, allow_origins
from .problems import install_handlers


def make_app(edge: Edge) -> ASGIApp:
    """Everything that HTTP offers, as one ASGI application."""
    app = FastAPI(
        title="REFINE",
        version="1",  # of the contract, as in the paths
        description="Refines a coarse mesh at test time from its silhouette and camera.",
        servers=[{"url": "/", "description": "The server that this document comes from."}],
        contact={"name": "The operator of this server"},
        license_info={"name": "Apache-2.0", "identifier": "Apache-2.0"},
        generate_unique_id_function=lambda route: route.name,  # what generated clients call their functions
        docs_url=None,  # page.py: without a CDN
        redoc_url=None,
        telemetry={"tracing": False},  # middleware.py has a span of each call, refused ones too
    )
    app.state.edge = edge
    for module in (refinements, cameras, events, artifacts, health, page):
        app.include_router(module.router)
    install_handlers(app)
    app.openapi = describe(app)  # type: ignore[method-assign]
    allow_origins(app, edge.settings)
    guarded = app if edge.settings.key_required else OwnPagesOnly(app, edge.settings)
    return HttpCalls(guarded, edge.metrics, tls=edge.settings.tls_certificate is not None)
