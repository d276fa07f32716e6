"""Submissions: read under limits, checked as far as that is cheap, stored and handed to JobStore.submit.

Both transports end in `submit`. The expensive checks of the same files are the worker's; what is refused here
has the reason that it would have there.
"""

from __future__ import annotations

import asyncio
import tempfile
from collections.abc import AsyncIterator
from dataclasses import dataclass
from typing import BinaryIO, cast

from obstore.exceptions import BaseError as BlobError
from starlette.datastructures import UploadFile

from refine_jobs import keys
from refine_jobs.blobs import Blob
from refine_jobs.edge_store import Submitted
from refine_jobs.record import Submission, Task
from refine_proto.errors import PayloadTooLarge, Unavailable, UploadTimeout, check_idempotency_key
from refine_proto.formats import HEAD_BYTES
from refine_proto.models import FieldError, RefinementSpec

from ..settings import ServiceSettings
from .call import Call
from .edge import Edge
from .file_checks import check_camera_size, recognise_mesh, silhouette_size

_MEMORY_BYTES = 2**20  # a larger file waits on disk
_CHUNK_BYTES = 2**20


@dataclass(frozen=True)
class Upload:
    """A submission as it was read: the files are rewound and belong to this object."""

    spec: RefinementSpec
    mesh: UploadFile
    silhouette: UploadFile

    async def aclose(self) -> None:
        """Remove the temporary files."""
        await self.mesh.close()
        await self.silhouette.close()


def new_file() -> UploadFile:
    """An empty file to fill."""
    return UploadFile(cast(BinaryIO, tempfile.SpooledTemporaryFile(max_size=_MEMORY_BYTES)), size=0)


async def submit(
    edge: Edge, call: Call, upload: Upload, idempotency_key: str | None, task: Task = Task.REFINE
) -> Submitted:
    """Check, store and submit."""
    spec = edge.store.check_options(await _checked(upload, edge.settings))
    if idempotency_key is not None:
        check_idempotency_key(idempotency_key)
    call.job_id = await edge.store.begin_upload(call.owner)
    try:
        mesh = await _store(edge, keys.input_blob(call.job_id, keys.MESH), upload.mesh)
        silhouette = await _store(edge, keys.input_blob(call.job_id, keys.SILHOUETTE), upload.silhouette)
    except BaseException:  # also when the caller has gone
        await asyncio.shield(edge.store.discard_upload(call.job_id))
        raise
    submitted = await edge.store.submit(
        Submission(
            id=call.job_id,
            owner=call.owner,
            spec=spec,
            task=task,
            mesh=mesh,
            silhouette=silhouette,
            idempotency_key=idempotency_key,
            request_id=call.request_id,
            traceparent=call.traceparent,
        )
    )
    call.job_id = submitted.refinement.id
    return submitted


async def _checked(upload: Upload, settings: ServiceSettings) -> RefinementSpec:
    """The spec with the format of the mesh, after all checks that need only the first bytes."""
    check_size("mesh", upload.mesh.size or 0, settings.max_mesh_bytes)
    check_size("silhouette", upload.silhouette.size or 0, settings.max_silhouette_bytes)
    mesh_format = recognise_mesh(await _head(upload.mesh), upload.mesh.filename, upload.spec.mesh_format)
    check_camera_size(upload.spec.camera, *silhouette_size(await _head(upload.silhouette)))
    return upload.spec.model_copy(update={"mesh_format": mesh_format})


def check_size(part: str, size_bytes: int, limit_bytes: int) -> None:
    """Raise PayloadTooLarge if a file is too large or announced to be."""
    if size_bytes > limit_bytes:
        detail = f"expected a {part} of at most {limit_bytes} bytes, got more"
        raise PayloadTooLarge(detail, errors=[FieldError(pointer=f"/{part}", detail=detail)])


def took_too_long(settings: ServiceSettings) -> UploadTimeout:
    """The error of an upload that does not end."""
    return UploadTimeout(
        f"expected the upload within {settings.upload_timeout_s:g} s, got only a part of it; send a smaller "
        "mesh or use a faster connection"
    )


async def _head(file: UploadFile) -> bytes:
    head = await file.read(HEAD_BYTES)
    await file.seek(0)
    return head


async def _store(edge: Edge, name: str, file: UploadFile) -> Blob:
    try:
        return await edge.blobs.put_stream(name, _chunks(file))
    except (OSError, BlobError) as error:
        raise Unavailable("the blob store takes no writes; try again", retry_after_s=5.0) from error


async def _chunks(file: UploadFile) -> AsyncIterator[bytes]:
    while chunk := await file.read(_CHUNK_BYTES):
        yield chunk
