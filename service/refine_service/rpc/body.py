"""The messages of CreateRefinement as an Upload."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator

from pydantic import ValidationError

from refine_proto.convert import to_model
from refine_proto.errors import InvalidInput, from_validation
from refine_proto.models import RefinementSpec
from refine_proto.v1 import refine_pb2 as pb

from ..edge.submit import Upload, check_size, new_file, took_too_long
from ..settings import ServiceSettings


async def read_messages(
    messages: AsyncIterator[pb.CreateRefinementRequest], settings: ServiceSettings
) -> tuple[str | None, Upload]:
    """The caller's request id, if any, and the upload; reads no further than the limits."""
    try:
        async with asyncio.timeout(settings.upload_timeout_s):
            header = await _header(messages, settings)
            spec = _spec(header)
            upload = Upload(spec, new_file(), new_file())
            try:
                await _fill(upload, messages, settings)
            except BaseException:
                await upload.aclose()
                raise
    except TimeoutError:
        raise took_too_long(settings) from None
    return (header.request_id if header.HasField("request_id") else None), upload


async def _header(
    messages: AsyncIterator[pb.CreateRefinementRequest], settings: ServiceSettings
) -> pb.CreateRefinementRequest.Header:
    first = await anext(aiter(messages), None)
    part = first.WhichOneof("part") if first is not None else None
    if first is None or part != "header":
        raise InvalidInput(f"expected the header as the first message, got {part or 'none'}")
    check_size("mesh", first.header.mesh_bytes, settings.max_mesh_bytes)
    check_size("silhouette", first.header.silhouette_bytes, settings.max_silhouette_bytes)
    return first.header


def _spec(header: pb.CreateRefinementRequest.Header) -> RefinementSpec:
    try:
        return to_model(header.spec, RefinementSpec)
    except ValidationError as error:
        raise from_validation(error.errors()) from None


async def _fill(
    upload: Upload, messages: AsyncIterator[pb.CreateRefinementRequest], settings: ServiceSettings
) -> None:
    parts = {
        "mesh_chunk": ("mesh", upload.mesh, settings.max_mesh_bytes),
        "silhouette_chunk": ("silhouette", upload.silhouette, settings.max_silhouette_bytes),
    }
    async for message in messages:
        part = message.WhichOneof("part") or "none"
        if part not in parts:
            raise InvalidInput(f"expected a chunk of the mesh or the silhouette after the header, got {part}")
        name, file, limit_bytes = parts[part]
        chunk = getattr(message, part)
        check_size(name, (file.size or 0) + len(chunk), limit_bytes)
        await file.write(chunk)
    for _, file, _ in parts.values():
        await file.seek(0)
