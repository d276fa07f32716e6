"""The body of `POST /v1/refinements`, multipart or JSON, as an Upload."""

from __future__ import annotations

import asyncio
from typing import Any, BinaryIO

from fastapi import Request
from pydantic import ValidationError
from pydantic_core import from_json
from starlette.datastructures import FormData, UploadFile
from starlette.formparsers import MultiPartException, MultiPartParser
from starlette.types import Message

from refine_proto.errors import FormatUnsupported, InvalidInput, PayloadTooLarge, from_validation
from refine_proto.formats import IGNORE, IMAGE_PARTS, MESH, SILHOUETTE, address_of, of_view
from refine_proto.models import RefinementRequest, RefinementSpec, View
from refine_proto.webhooks import URL

from ..edge.submit import MEMORY_BYTES, Upload, filled_file, new_file, receiving
from ..settings import ServiceSettings

_FILES = (MESH, *IMAGE_PARTS)
_URLS = {address_of(name): name for name in _FILES}
_JSON_FIELDS = ("camera", "options", "views", "webhook", "metadata")
_MAX_FIELDS = 32  # more than there are: an unknown one is named, not counted
_FIELD_BYTES = 64 * 1024
_FRAMING_BYTES = 2**20  # of a multipart body around its files
_MAX_VALUES = 10_000  # of the JSON of one request; eight views with their cameras have a few hundred
_parsing = asyncio.Semaphore(2)  # JSON bodies that are in memory at a time: each is there several times over


async def read_body(request: Request, settings: ServiceSettings) -> Upload:
    """Read the body, no further than the limits; raises InvalidInput with the fields' pointers."""
    media_type = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    async with receiving(settings):
        if media_type == "multipart/form-data":
            return await _read_multipart(request, settings)
        if media_type == "application/json":
            return await _read_json(request, settings)
    raise FormatUnsupported(
        f"expected Content-Type multipart/form-data or application/json, got {media_type or 'none'}"
    )


class _MultiPartParser(MultiPartParser):
    spool_max_size = MEMORY_BYTES


async def _read_multipart(request: Request, settings: ServiceSettings) -> Upload:
    limit = settings.max_mesh_bytes + settings.max_silhouette_bytes + _FRAMING_BYTES
    parser = _MultiPartParser(
        request.headers,
        _limited(request, limit).stream(),
        max_files=_MAX_FIELDS,
        max_fields=_MAX_FIELDS,
        max_part_size=_FIELD_BYTES,
    )
    try:
        form = await parser.parse()
    except MultiPartException as error:
        raise InvalidInput(f"malformed request: {error.message}") from None
    try:
        files = {name: _file(form, name) for name in _FILES if name in form}
        values = await _values(form)
        urls = {part: _url(name, values.pop(name)) for name, part in _URLS.items() if name in values}
        return Upload(_spec(values), files, urls)
    except BaseException:
        await form.close()
        raise


def _file(form: FormData, name: str) -> UploadFile:
    value = form.get(name)
    if isinstance(value, UploadFile):
        return value
    message = f"expected a file, got a field without a file name; its address goes into {address_of(name)}"
    raise from_validation([{"loc": (name,), "msg": message}])


def _url(name: str, text: Any) -> str:
    try:
        return URL.validate_python(text)
    except ValidationError as error:
        raise from_validation(error.errors(), under=(name,)) from None


async def _values(form: FormData) -> dict[str, Any]:
    """From the fields beside the files; `curl -F camera=@camera.json` sends a field as a file."""
    values: dict[str, Any] = {}
    for name, value in form.multi_items():
        if name in values or (name in _FILES and len(form.getlist(name)) > 1):
            raise from_validation([{"loc": (name,), "msg": "expected one field of this name, got several"}])
        if name in _FILES:
            continue
        text = value if isinstance(value, str) else await _read_and_close(value)
        if len(text) > _FIELD_BYTES:
            raise PayloadTooLarge(f"expected at most {_FIELD_BYTES} bytes in the field {name}, got more")
        values[name] = _parse(name, text) if name in _JSON_FIELDS else _text(text)
    return values


def _spec(values: dict[str, Any]) -> RefinementSpec:
    try:
        return RefinementSpec.model_validate(values)
    except ValidationError as error:
        raise from_validation(error.errors()) from None


async def _read_and_close(file: UploadFile) -> bytes:
    try:
        return await file.read(_FIELD_BYTES + 1)
    finally:
        await file.close()


def _text(value: str | bytes) -> str:
    return value if isinstance(value, str) else value.decode(errors="replace")


def _parse(name: str, text: str | bytes) -> Any:
    _check_values(text.encode() if isinstance(text, str) else text)
    try:
        return from_json(text)
    except ValueError as error:
        raise from_validation([{"loc": (name,), "msg": f"expected JSON: {error}"}]) from None


async def _read_json(request: Request, settings: ServiceSettings) -> Upload:
    """Waits on disk until it is whole, and is parsed in a thread: neither may hold up other calls."""
    body = new_file()
    try:
        async for chunk in _limited(request, settings.max_json_bytes).stream():
            await body.write(chunk)
        async with _parsing:
            return await asyncio.to_thread(_parse_json, body.file)
    finally:
        await body.close()


def _parse_json(body: BinaryIO) -> Upload:
    body.seek(0)
    text = body.read()
    _check_values(text)
    try:
        parsed = RefinementRequest.model_validate_json(text)
    except ValidationError as error:
        raise from_validation(error.errors()) from None
    spec = RefinementSpec(
        camera=parsed.camera,
        options=parsed.options,
        mesh_format=parsed.mesh_format,
        views=[View(camera=view.camera) for view in parsed.views],
        webhook=parsed.webhook,
        metadata=parsed.metadata,
    )
    files, urls = {MESH: parsed.mesh}, {MESH: parsed.mesh_url}
    for number, view in enumerate((parsed, *parsed.views), 1):
        for part in (SILHOUETTE, IGNORE):
            files[of_view(part, number)] = getattr(view, part)
            urls[of_view(part, number)] = getattr(view, address_of(part))
    return Upload(
        spec,
        {name: filled_file(data) for name, data in files.items() if data is not None},
        {name: url for name, url in urls.items() if url is not None},
    )


def _check_values(text: bytes) -> None:
    """Raise PayloadTooLarge for JSON of more values than any request has; they are not parsed."""
    values = sum(text.count(sign) for sign in (b",", b"[", b"{"))
    if values > _MAX_VALUES:
        raise PayloadTooLarge(f"expected JSON of at most {_MAX_VALUES} values, got more; see /docs")


def _limited(request: Request, limit_bytes: int) -> Request:
    """The request with a body that is not read any further than the limit."""
    too_large = PayloadTooLarge(
        f"expected a body of at most {limit_bytes} bytes, got more; large files go as multipart/form-data"
    )
    if int(request.headers.get("content-length", 0)) > limit_bytes:
        raise too_large
    received = 0

    async def receive() -> Message:
        nonlocal received
        message = await request.receive()
        received += len(message.get("body", b""))
        if received > limit_bytes:
            raise too_large
        return message

    return Request(request.scope, receive)
