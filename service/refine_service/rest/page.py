"""The page for people at `/`, and Swagger UI at `/docs`.

Files of the package, read and compressed once, with a policy that lets them load nothing from elsewhere.
"""

from __future__ import annotations

import gzip
import hashlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path, PurePath
from typing import Annotated

from fastapi import APIRouter, Header
from fastapi.responses import Response

from refine_proto.errors import NotFound

_CLONE_SAMPLES = Path(__file__).parents[3] / "examples/samples"
_MEDIA_TYPES = {
    ".html": "text/html; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".svg": "image/svg+xml",
    ".png": "image/png",
    ".json": "application/json",
    ".obj": "model/obj",
}
_COMPRESSED = (".png",)  # already
# blob: and data: are what a glTF's embedded textures and buffers become.
_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob: data:; "
    "connect-src 'self' blob: data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
_HEADERS = {
    "Content-Security-Policy": _POLICY,
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-cache",  # kept, and asked about each time: the ETag changes with the version
    "Vary": "Accept-Encoding",
}

AcceptEncoding = Annotated[str, Header()]
IfNoneMatch = Annotated[str, Header()]
router = APIRouter(include_in_schema=False)


@dataclass(frozen=True)
class _File:
    body: bytes
    gzipped: bytes | None
    media_type: str
    etag: str


@router.api_route("/", methods=["GET", "HEAD"])
async def page(accept_encoding: AcceptEncoding = "", if_none_match: IfNoneMatch = "") -> Response:
    """Refinements for people."""
    return _answer("index.html", accept_encoding, if_none_match)


@router.api_route("/docs", methods=["GET", "HEAD"])
async def docs(accept_encoding: AcceptEncoding = "", if_none_match: IfNoneMatch = "") -> Response:
    """The API for people."""
    return _answer("docs.html", accept_encoding, if_none_match)


@router.api_route("/page/{name:path}", methods=["GET", "HEAD"])
async def page_file(
    name: str, accept_encoding: AcceptEncoding = "", if_none_match: IfNoneMatch = ""
) -> Response:
    """What the two load."""
    return _answer(name, accept_encoding, if_none_match)


def _answer(name: str, accept_encoding: str, if_none_match: str) -> Response:
    file = _files().get(name)
    if file is None:
        raise NotFound(f"expected a file of the page, got {name!r:.100}")
    headers = {**_HEADERS, "ETag": file.etag}
    if file.etag in if_none_match:
        return Response(status_code=304, headers=headers)
    if file.gzipped is None or "gzip" not in accept_encoding:
        return Response(file.body, headers=headers, media_type=file.media_type)
    return Response(file.gzipped, headers=headers | {"Content-Encoding": "gzip"}, media_type=file.media_type)


@cache
def _files() -> Mapping[str, _File]:
    """Every file of the page by its path below /page/."""
    return {
        name: _read(name, file)
        for name, file in _walk(resources.files("refine_service") / "page")
        if _suffix(name) in _MEDIA_TYPES
    } | {
        f"samples/{name}": _read(name, file)
        for name, file in _walk(_samples())
        if _suffix(name) in _MEDIA_TYPES
    }


def _samples() -> Traversable:
    """Those of the clone that this file lies in, else those that the installation carries."""
    return _CLONE_SAMPLES if _CLONE_SAMPLES.is_dir() else resources.files("refine_service") / "samples"


def _walk(folder: Traversable, prefix: str = "") -> Iterator[tuple[str, Traversable]]:
    """Name and file of everything below; a file that is stored as NAME.gz is NAME."""
    for item in folder.iterdir():
        if item.is_dir():
            yield from _walk(item, f"{prefix}{item.name}/")
        else:
            yield f"{prefix}{item.name.removesuffix('.gz')}", item


def _suffix(name: str) -> str:
    return PurePath(name).suffix


def _read(name: str, file: Traversable) -> _File:
    stored = file.read_bytes()
    body = gzip.decompress(stored) if file.name.endswith(".gz") else stored
    gzipped = None if _suffix(name) in _COMPRESSED else gzip.compress(body, mtime=0)
    return _File(body, gzipped, _MEDIA_TYPES[_suffix(name)], f'"{hashlib.sha256(body).hexdigest()[:32]}"')
