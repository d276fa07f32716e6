"""What a submission sends: its files and a checked spec."""

from __future__ import annotations

import io
import os
import uuid
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple
from urllib.parse import urlsplit

from pydantic import ValidationError
from typing_extensions import TypeIs

from refine_proto.errors import check_idempotency_key, from_validation
from refine_proto.formats import IGNORE, MESH, SILHOUETTE, format_of_name, of_view
from refine_proto.models import (
    CameraSpec,
    EstimatedCamera,
    MeshFormat,
    RefinementOptions,
    RefinementSpec,
    Webhook,
)

CHUNK_BYTES = 64 * 1024
Source = bytes | str | os.PathLike[str]
"""The content of a file, its path, or its https address. A path is read while it is sent, never as a whole.

What has an address is fetched by the server.
"""


@dataclass(frozen=True)
class View:
    """A further view of the same object: its silhouette, the camera that saw it, what is unknown in it."""

    silhouette: Source
    camera: CameraSpec | Mapping[str, Any]
    ignore: Source | None = None


class OpenFile(NamedTuple):
    name: str
    stream: BinaryIO
    size_bytes: int

    def chunks(self) -> Iterator[bytes]:
        while chunk := self.stream.read(CHUNK_BYTES):
            yield chunk


@dataclass(frozen=True)
class Upload:
    """A submission that can be sent any number of times; its key makes them one."""

    spec: RefinementSpec
    files: Mapping[str, Source]  # by their names in the request: mesh, silhouette, ignore, silhouette_2, ...
    idempotency_key: str
    urls: Mapping[str, str] = field(
        default_factory=dict
    )  # of files that the server fetches, by the same names

    @contextmanager
    def opened(self) -> Iterator[dict[str, OpenFile]]:
        """All files by name, from their beginnings; OSError if one cannot be read."""
        with ExitStack() as stack:
            yield {name: stack.enter_context(_open(file, name)) for name, file in self.files.items()}


def make_upload(
    mesh: Source,
    silhouette: Source,
    camera: CameraSpec | Mapping[str, Any],
    options: RefinementOptions | Mapping[str, Any] | None = None,
    mesh_format: MeshFormat | str | None = None,
    idempotency_key: str | None = None,
    ignore: Source | None = None,
    views: Sequence[View] = (),
    webhook: Webhook | Mapping[str, Any] | None = None,
    metadata: Mapping[str, str] | None = None,
) -> Upload:
    """Check everything but the files; InvalidInput, the server's errors, if something is wrong."""
    if mesh_format is None and not isinstance(mesh, bytes):
        mesh_format = format_of_name(urlsplit(mesh).path if is_address(mesh) else os.fspath(mesh))
    try:
        spec = RefinementSpec.model_validate(
            {
                "camera": camera,
                "options": options or RefinementOptions(),
                "mesh_format": mesh_format,
                "views": [{"camera": view.camera} for view in views],
                "webhook": webhook,
                "metadata": metadata or {},
            }
        )
    except ValidationError as error:
        raise from_validation(error.errors()) from None
    key = str(uuid.uuid4()) if idempotency_key is None else idempotency_key
    check_idempotency_key(key)
    images = {
        of_view(part, number): file
        for number, view in enumerate((View(silhouette, camera, ignore), *views), 1)
        for part, file in ((SILHOUETTE, view.silhouette), (IGNORE, view.ignore))
        if file is not None
    }
    sources: dict[str, Source] = {MESH: mesh, **images}
    urls = {name: source for name, source in sources.items() if is_address(source)}
    files = {name: source for name, source in sources.items() if name not in urls}
    return Upload(spec, files, key, urls)


def is_address(source: Source) -> TypeIs[str]:
    """Whether the server fetches it."""
    return isinstance(source, str) and source.startswith(("https://", "http://"))


def to_estimate(camera: EstimatedCamera | Mapping[str, Any] | None) -> EstimatedCamera | Mapping[str, Any]:
    """A camera that is not known, from what is known of it; its type need not be said."""
    if camera is None:
        return EstimatedCamera()
    return {"type": "estimate", **camera} if isinstance(camera, Mapping) else camera


@contextmanager
def _open(source: Source, name: str) -> Iterator[OpenFile]:
    if isinstance(source, bytes):
        yield OpenFile(name, io.BytesIO(source), len(source))
        return
    with Path(source).open("rb") as stream:
        yield OpenFile(Path(source).name, stream, os.fstat(stream.fileno()).st_size)
