"""The messages of CreateRefinement as an Upload."""

from __future__ import annotations

from collections.abc import AsyncIterator

from pydantic import ValidationError
from starlette.datastructures import UploadFile

from refine_proto.convert import to_model
from refine_proto.errors import InvalidInput, from_validation
from refine_proto.formats import IMAGE_PARTS, MESH, SILHOUETTE, address_of
from refine_proto.models import RefinementSpec
from refine_proto.v1 import refine_pb2 as pb
from refine_proto.webhooks import URL

from ..edge.submit import Upload, check_size, new_file, receiving
from ..settings import ServiceSettings


async def read_messages(
    messages: AsyncIterator[pb.CreateRefinementRequest], settings: ServiceSettings
) -> tuple[str | None, Upload]:
    """The caller's request id, if any, and the upload; reads no further than the limits."""
    async with receiving(settings):
        header = await _header(messages, settings)
        spec = _spec(header)
        urls = _urls(header)
        files = {name: new_file() for name in (MESH, SILHOUETTE) if name not in urls}
        upload = Upload(spec, files, urls)
        try:
            await _fill(files, messages, settings)
        except BaseException:
            await upload.aclose()
            raise
    return (header.request_id if header.HasField("request_id") else None), upload


async def _header(
    messages: AsyncIterator[pb.CreateRefinementRequest], settings: ServiceSettings
) -> pb.CreateRefinementRequest.Header:
    first = await anext(aiter(messages), None)
    part = first.WhichOneof("part") if first is not None else None
    if first is None or part != "header":
        raise InvalidInput(f"expected the header as the first message, got {part or 'none'}")
    check_size(MESH, first.header.mesh_bytes, settings.max_mesh_bytes)
    check_size(SILHOUETTE, first.header.silhouette_bytes, settings.max_silhouette_bytes)
    return first.header


def _spec(header: pb.CreateRefinementRequest.Header) -> RefinementSpec:
    try:
        return to_model(header.spec, RefinementSpec)
    except ValidationError as error:
        raise from_validation(error.errors()) from None


def _urls(header: pb.CreateRefinementRequest.Header) -> dict[str, str]:
    for name, url in header.file_urls.items():
        if name not in (MESH, *IMAGE_PARTS):
            raise InvalidInput(f"expected file_urls of {', '.join((MESH, *IMAGE_PARTS))}, got {name[:40]!r}")
        try:
            URL.validate_python(url)
        except ValidationError as error:
            raise from_validation(error.errors(), under=(address_of(name),)) from None
    return dict(header.file_urls)


async def _fill(
    files: dict[str, UploadFile],
    messages: AsyncIterator[pb.CreateRefinementRequest],
    settings: ServiceSettings,
) -> None:
    image_bytes = 0
    async for message in messages:
        name, chunk = _chunk(message)
        if name not in files:
            files[name] = new_file()
        file = files[name]
        if name == MESH:
            check_size(MESH, (file.size or 0) + len(chunk), settings.max_mesh_bytes)
        else:
            image_bytes += len(chunk)
            check_size(SILHOUETTE, image_bytes, settings.max_silhouette_bytes)
        await file.write(chunk)
    for file in files.values():
        await file.seek(0)


def _chunk(message: pb.CreateRefinementRequest) -> tuple[str, bytes]:
    """The name of a file and some of its bytes."""
    match message.WhichOneof("part"):
        case "mesh_chunk":
            return MESH, message.mesh_chunk
        case "silhouette_chunk":
            return SILHOUETTE, message.silhouette_chunk
        case "file_chunk" if message.file_chunk.part in IMAGE_PARTS:
            return message.file_chunk.part, message.file_chunk.data
        case "file_chunk":
            raise InvalidInput(
                f"expected a file_chunk with one of the parts {', '.join(IMAGE_PARTS)}, "
                f"got {message.file_chunk.part[:40]!r}"
            )
        case part:
            raise InvalidInput(f"expected a chunk of a file after the header, got {part or 'none'}")
