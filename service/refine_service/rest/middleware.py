"""REST around the routes: the call of a request, its log line and metrics, and headers on every answer."""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping

from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from refine_jobs.logs import fields
from refine_proto.tracing import Kind, span

from ..edge.call import Call, begin_call
from ..edge.prometheus import Metrics
from .origins import SECURITY_HEADERS, STRICT_TRANSPORT

_PROBES = ("/livez", "/readyz", "/metrics", "/metrics/installation")  # asked every few seconds: no spans
_PIECE_BYTES = 64 * 1024
_MAX_PATH = 200  # characters of it in a line of the log
log = logging.getLogger(__name__)


class HttpCalls:
    """The outermost ASGI layer: makes the Call, counts, logs, and adds headers to every answer."""

    def __init__(self, app: ASGIApp, metrics: Metrics, tls: bool) -> None:
        self._app, self._metrics = app, metrics
        strict = {"Strict-Transport-Security": STRICT_TRANSPORT} if tls else {}
        self._headers = SECURITY_HEADERS | strict

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """One request."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        headers = Headers(scope=scope)
        call = begin_call(headers)
        exchange = _Exchange(call, self._headers, receive, send, has_body=_has_body(headers))
        if scope["path"] in _PROBES:
            await self._answer(scope, call, exchange)
            return
        attributes = {"http.request.method": scope["method"], "url.path": scope["path"]}
        with span(scope["method"], Kind.SERVER, call.traceparent, attributes) as work:
            call.traceparent = work.traceparent or call.traceparent
            try:
                await self._answer(scope, call, exchange)
            finally:
                work.rename(_method(scope))
                work.set({"http.route": _route(scope), "http.response.status_code": exchange.status or 499})
                if exchange.status >= 500:
                    work.fail(str(exchange.status))

    async def _answer(self, scope: Scope, call: Call, exchange: _Exchange) -> None:
        started = time.perf_counter()
        try:
            await self._app(scope, exchange.receive, exchange.send)
        except Exception:
            if not exchange.status:
                raise
            log.debug("the answer was sent before this error", exc_info=True)  # the handlers have logged it
        finally:
            self._account(scope, call, exchange, time.perf_counter() - started)

    def _account(self, scope: Scope, call: Call, exchange: _Exchange, seconds: float) -> None:
        method = _method(scope)
        status = str(exchange.status or 499)
        self._metrics.observe("rest", method, status, seconds)
        self._metrics.count_bytes("rest", exchange.received_bytes, exchange.sent_bytes)
        log.info(
            "%s %s %s",
            scope["method"],
            scope["path"][:_MAX_PATH],
            status,
            extra=fields(
                method=method,
                status=status,
                seconds=round(seconds, 4),
                owner=call.owner,
                received_bytes=exchange.received_bytes,
                sent_bytes=exchange.sent_bytes,
            ),
        )


class _Exchange:
    """What goes in and out during one request."""

    def __init__(
        self, call: Call, headers: Mapping[str, str], receive: Receive, send: Send, has_body: bool
    ) -> None:
        self._call, self._headers, self._receive, self._send = call, headers, receive, send
        self._unread = has_body
        self.status = 0
        self.received_bytes = self.sent_bytes = 0

    async def receive(self) -> Message:
        message = await self._receive()
        if message["type"] == "http.request":
            self.received_bytes += len(message.get("body", b""))
            self._unread = self._unread and message.get("more_body", False)
        return message

    async def send(self, message: Message) -> None:
        if message["type"] == "http.response.start":
            self.status = message["status"]
            headers = MutableHeaders(scope=message)
            headers["X-Request-Id"] = self._call.request_id
            for name, value in self._headers.items():
                headers.setdefault(name, value)
            if self._call.traceparent:
                headers["traceparent"] = self._call.traceparent
            if self._unread:  # the rest of the body shall not be sent
                headers["Connection"] = "close"
            await self._send(message)
            return
        body = memoryview(message.get("body", b""))
        self.sent_bytes += len(body)
        # In pieces: the server waits between them for a reader that takes nothing.
        for start in range(0, max(1, len(body)), _PIECE_BYTES):
            piece = body[start : start + _PIECE_BYTES]
            more = message.get("more_body", False) or start + _PIECE_BYTES < len(body)
            await self._send({**message, "body": bytes(piece), "more_body": more})


def _route(scope: Scope) -> str:
    """The pattern: ids would be endless labels."""
    return getattr(scope.get("route"), "path", "(none)")


def _method(scope: Scope) -> str:
    return f"{scope['method']} {_route(scope)}"


def _has_body(headers: Headers) -> bool:
    return "transfer-encoding" in headers or headers.get("content-length", "0") != "0"
