"""Submissions: read under limits, checked as far as that is cheap, stored and handed to JobStore.submit.

Both transports end in `submit`. The expensive checks of the same files are the worker's; what is refused here
has the reason that it would have there.
"""

from __future__ import annotations

import asyncio
import logging
import tempfile
from collections.abc import AsyncIterator, Mapping
from contextlib import aclosing, asynccontextmanager
from dataclasses import dataclass, field
from typing import BinaryIO, cast

from starlette.datastructures import UploadFile

from refine_jobs import keys
from refine_jobs.blobs import Blob
from refine_jobs.edge_store import Submitted
from refine_jobs.record import Submission, Task
from refine_jobs.spans import enqueue_span
from refine_proto.errors import (
    OptionsInvalid,
    PayloadTooLarge,
    Unavailable,
    UploadTimeout,
    check_idempotency_key,
    from_validation,
)
from refine_proto.formats import HEAD_BYTES, IGNORE, MESH, SILHOUETTE, of_view
from refine_proto.models import CameraSpec, FieldError, Priority, RefinementSpec

from ..settings import ServiceSettings
from .call import Call
from .edge import Edge
from .fetch import fetch, file_name
from .file_checks import check_camera_size, image_size, recognise_mesh
from .webhooks import check_webhook

MEMORY_BYTES = 128 * 1024  # a larger file waits on disk
_STORING = 16  # files at a time in one process: each needs some 8 MiB on its way to the store
_CHUNK_BYTES = 2**20
_FULL_RETRY_S = 5.0  # somebody has to make room
_storing = asyncio.Semaphore(_STORING)


log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Upload:
    """A submission as it was read: the files are rewound and belong to this object."""

    spec: RefinementSpec
    files: dict[str, UploadFile]  # by their names in the request: mesh, silhouette, ignore, silhouette_2, ...
    urls: Mapping[str, str] = field(
        default_factory=dict
    )  # of files that are to be fetched, by the same names

    async def aclose(self) -> None:
        """Remove the temporary files."""
        for file in self.files.values():
            await file.close()

    @property
    def cameras(self) -> list[CameraSpec]:
        """Of all views, the first included."""
        return [self.spec.camera, *(view.camera for view in self.spec.views)]


def new_file() -> UploadFile:
    """An empty file to fill."""
    return UploadFile(cast(BinaryIO, tempfile.SpooledTemporaryFile(max_size=MEMORY_BYTES)), size=0)


def filled_file(data: bytes) -> UploadFile:
    """A file of these bytes, rewound."""
    file = new_file()
    file.file.write(data)
    file.file.seek(0)
    file.size = len(data)
    return file


async def submit(
    edge: Edge, call: Call, upload: Upload, idempotency_key: str | None, task: Task = Task.REFINE
) -> Submitted:
    """Fetch what has an address, check, store and submit."""
    _check_priority(upload.spec.options.priority, call.max_priority)
    _check_parts(upload)
    await _fetch_files(edge, upload)
    spec = edge.store.check_options(await _checked(upload, edge.settings))
    if task is Task.REFINE:
        check_webhook(edge, call.owner, spec)
    else:
        spec = spec.model_copy(update={"webhook": None})  # who asks waits for the answer
    if idempotency_key is not None:
        check_idempotency_key(idempotency_key)
    call.job_id = await edge.store.begin_upload(call.owner)
    try:
        blobs = {
            name: await _store(edge, keys.input_blob(call.job_id, name), file)
            for name, file in upload.files.items()
        }
    except BaseException:  # also when the caller has gone
        await asyncio.shield(edge.store.discard_upload(call.job_id))
        raise
    with enqueue_span(edge.store.queue, call.job_id, call.traceparent) as span:
        submitted = await edge.store.submit(
            Submission(
                id=call.job_id,
                owner=call.owner,
                spec=spec,
                task=task,
                mesh=blobs.pop(MESH),
                silhouette=blobs.pop(SILHOUETTE),
                more_files=blobs,
                idempotency_key=idempotency_key,
                request_id=call.request_id,
                traceparent=span.traceparent or call.traceparent,
            )
        )
    call.job_id = submitted.refinement.id
    return submitted


def _check_priority(priority: Priority, limit: Priority) -> None:
    """Raise OptionsInvalid for more than the key allows."""
    order = list(Priority)
    if order.index(priority) > order.index(limit):
        detail = (
            f"expected a priority of at most {limit} with this key, got {priority}; leave it out, or ask the "
            "operator for a key that may"
        )
        raise OptionsInvalid(detail, errors=[FieldError(pointer="/options/priority", detail=detail)])


async def _checked(upload: Upload, settings: ServiceSettings) -> RefinementSpec:
    """The spec with the format of the mesh, after all checks that need only the files' headers."""
    mesh, images = upload.files[MESH], {name: file for name, file in upload.files.items() if name != MESH}
    check_size(MESH, mesh.size or 0, settings.max_mesh_bytes)
    check_size(SILHOUETTE, sum(file.size or 0 for file in images.values()), settings.max_silhouette_bytes)
    mesh_format = recognise_mesh(await _head(mesh), mesh.filename, upload.spec.mesh_format)
    sizes = {name: image_size(file.file, name) for name, file in images.items()}
    for number, camera in enumerate(upload.cameras, 1):
        place = "camera" if number == 1 else f"views/{number - 2}/camera"
        check_camera_size(camera, place, *sizes[of_view(SILHOUETTE, number)])
    return upload.spec.model_copy(update={"mesh_format": mesh_format})


def _check_parts(upload: Upload) -> None:
    """Raise InvalidInput unless every view, and no other, has a silhouette, as a file or an address."""
    for name in upload.files.keys() & upload.urls.keys():
        raise from_validation([{"loc": (name,), "msg": "expected the file or its address, got both"}])
    views = range(1, len(upload.cameras) + 1)
    wanted = {MESH, *(of_view(SILHOUETTE, number) for number in views)}
    allowed = wanted | {of_view(IGNORE, number) for number in views}
    given = {*upload.files, *upload.urls}
    missing, surplus = sorted(wanted - given), sorted(given - allowed)
    if missing or surplus:
        no_view = f"expected no file of this name, got one: `views` has {len(views) - 1} further cameras"
        told = [*((name, "expected a file, got none") for name in missing), *((n, no_view) for n in surplus)]
        raise from_validation([{"loc": (name,), "msg": message} for name, message in told])


async def _fetch_files(edge: Edge, upload: Upload) -> None:
    """Fill `upload.files` from its addresses, no further than the limits."""
    settings = edge.settings
    image_bytes = sum(file.size or 0 for name, file in upload.files.items() if name != MESH)
    async with receiving(settings):
        for name, url in upload.urls.items():
            upload.files[name] = file = new_file()
            file.filename = file_name(url)
            async with aclosing(fetch(edge.outgoing, name, url)) as chunks:
                async for chunk in chunks:
                    if name == MESH:
                        check_size(MESH, (file.size or 0) + len(chunk), settings.max_mesh_bytes)
                    else:
                        image_bytes += len(chunk)
                        check_size(SILHOUETTE, image_bytes, settings.max_silhouette_bytes)
                    await file.write(chunk)
            await file.seek(0)


def check_size(part: str, size_bytes: int, limit_bytes: int) -> None:
    """Raise PayloadTooLarge if the mesh, or all images together, are too large or announced to be."""
    if size_bytes > limit_bytes:
        detail = f"expected a {part} of at most {limit_bytes} bytes, got more"
        raise PayloadTooLarge(detail, errors=[FieldError(pointer=f"/{part}", detail=detail)])


@asynccontextmanager
async def receiving(settings: ServiceSettings) -> AsyncIterator[None]:
    """Around the reading of an upload: raises UploadTimeout, and Unavailable if its files find no room."""
    try:
        async with asyncio.timeout(settings.upload_timeout_s):
            yield
    except TimeoutError:
        raise UploadTimeout(
            f"expected the upload within {settings.upload_timeout_s:g} s, got only a part of it; send a "
            "smaller mesh or use a faster connection"
        ) from None
    except OSError as error:
        log.warning("an upload found no room in %s: %s", tempfile.gettempdir(), error)
        raise Unavailable(
            "the service's temporary folder takes no writes; try again", retry_after_s=_FULL_RETRY_S
        ) from error


async def _head(file: UploadFile) -> bytes:
    head = await file.read(HEAD_BYTES)
    await file.seek(0)
    return head


async def _store(edge: Edge, name: str, file: UploadFile) -> Blob:
    async with _storing:
        return await edge.blobs.put_stream(name, _chunks(file))


async def _chunks(file: UploadFile) -> AsyncIterator[bytes]:
    while chunk := await file.read(_CHUNK_BYTES):
        yield chunk
