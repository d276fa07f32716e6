"""Pages of other sites in a user's browser: what they may ask of this service, and what it tells browsers.

A page may send a form to any address, also to this machine's, and a name that its owner controls may be
pointed at this machine (DNS rebinding). Where a key is needed that is harmless: a page has none. Where none
is needed, the browser's own headers decide.
"""

from __future__ import annotations

import ipaddress
from urllib.parse import urlsplit

from fastapi import FastAPI
from starlette.middleware.cors import CORSMiddleware
from starlette.types import ASGIApp, Receive, Scope, Send

from refine_proto.errors import Forbidden

from ..settings import ServiceSettings
from .problems import problem_response

_METHODS = ("GET", "HEAD", "POST", "PATCH", "DELETE")
_ASKED = (
    *("Authorization", "Content-Type", "Idempotency-Key", "If-None-Match", "If-Range", "Last-Event-ID"),
    *("Prefer", "Range", "traceparent", "X-Request-Id"),
)
_TOLD = (
    *("Content-Disposition", "Content-Range", "ETag", "Idempotency-Replayed", "Location"),
    *("Preference-Applied", "Retry-After", "X-Request-Id"),
)

SECURITY_HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Content-Security-Policy": "default-src 'none'; frame-ancestors 'none'",
    "Cache-Control": "no-store",
}
"""On every answer that does not say otherwise itself."""

STRICT_TRANSPORT = "max-age=31536000"


def allow_origins(app: FastAPI, settings: ServiceSettings) -> None:
    """Answer the browser's questions (CORS) about pages of `cors_origins`; without any, of none."""
    if settings.cors_origins:
        app.add_middleware(
            CORSMiddleware,
            allow_origins=settings.cors_origins,
            allow_methods=_METHODS,
            allow_headers=_ASKED,
            expose_headers=_TOLD,
        )


class OwnPagesOnly:
    """An ASGI layer that refuses what a browser sends for another site's page."""

    def __init__(self, app: ASGIApp, settings: ServiceSettings) -> None:
        self._app = app
        self._loopback = settings.is_loopback
        self._origins = frozenset(settings.cors_origins)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """One request."""
        if scope["type"] == "http" and (problem := self._wrong(scope)):
            await problem_response(Forbidden(problem))(scope, receive, send)
        else:
            await self._app(scope, receive, send)

    def _wrong(self, scope: Scope) -> str | None:
        headers = dict(scope["headers"])
        host = headers.get(b"host", b"").decode("latin-1")
        if self._loopback and not _is_this_machine(host):
            return (
                f"expected a Host of this machine (localhost, 127.0.0.1), got {host!r:.100}; a service "
                "behind a proxy needs REFINE_REQUIRE_KEY=true"
            )
        origin = headers.get(b"origin", b"").decode("latin-1")
        if origin and origin not in self._origins and urlsplit(origin).netloc != host:
            return (
                f"expected no Origin, or this service's own, got {origin!r:.100}; REFINE_CORS_ORIGINS lets "
                "pages of other origins in"
            )
        return None


def _is_this_machine(host: str) -> bool:
    try:
        name = urlsplit(f"//{host}").hostname or ""
        return name == "localhost" or name.endswith(".localhost") or ipaddress.ip_address(name).is_loopback
    except ValueError:
        return False
