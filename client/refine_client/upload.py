"""What a submission sends: two files and a checked spec."""

from __future__ import annotations

import io
import os
import uuid
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

from pydantic import ValidationError

from refine_proto.errors import check_idempotency_key, from_validation
from refine_proto.formats import format_of_name
from refine_proto.models import CameraSpec, MeshFormat, RefinementOptions, RefinementSpec

CHUNK_BYTES = 64 * 1024
Source = bytes | str | os.PathLike[str]
"""The content of a file, or its path. A path is read while it is sent, never as a whole."""


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
    mesh: Source
    silhouette: Source
    idempotency_key: str

    @contextmanager
    def opened(self) -> Iterator[tuple[OpenFile, OpenFile]]:
        """The mesh and the silhouette, from their beginnings; OSError if one cannot be read."""
        with _open(self.mesh, "mesh") as mesh, _open(self.silhouette, "silhouette") as silhouette:
            yield mesh, silhouette


def make_upload(
    mesh: Source,
    silhouette: Source,
    camera: CameraSpec | Mapping[str, Any],
    options: RefinementOptions | Mapping[str, Any] | None = None,
    mesh_format: MeshFormat | str | None = None,
    idempotency_key: str | None = None,
) -> Upload:
    """Check everything but the files; InvalidInput, the server's errors, if something is wrong."""
    if mesh_format is None and not isinstance(mesh, bytes):
        mesh_format = format_of_name(os.fspath(mesh))
    try:
        spec = RefinementSpec.model_validate(
            {"camera": camera, "options": options or RefinementOptions(), "mesh_format": mesh_format}
        )
    except ValidationError as error:
        raise from_validation(error.errors()) from None
    key = str(uuid.uuid4()) if idempotency_key is None else idempotency_key
    check_idempotency_key(key)
    return Upload(spec, mesh, silhouette, key)


@contextmanager
def _open(source: Source, name: str) -> Iterator[OpenFile]:
    if isinstance(source, bytes):
        yield OpenFile(name, io.BytesIO(source), len(source))
        return
    with Path(source).open("rb") as stream:
        yield OpenFile(Path(source).name, stream, os.fstat(stream.fileno()).st_size)
