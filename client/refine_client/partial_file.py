"""An artifact on its way to disk: appended to as bytes come, checked at the end, then moved into place."""

from __future__ import annotations

import difflib
import hashlib
import os
from collections.abc import Iterable
from pathlib import Path
from types import TracebackType
from typing import NoReturn, Self

from refine_proto.errors import Conflict, InvalidInput, NotFound, ServerError
from refine_proto.models import Artifact, Refinement

from .errors import ConnectionLost, DownloadCorrupt

READ_BYTES = 1024 * 1024


class PartialFile:
    """Writes `directory/.NAME.SHA.part` until all bytes of the artifact are there, then `directory/NAME`.

    What an earlier, interrupted download of the same content left is kept and continued.
    """

    def __init__(self, artifact: Artifact, directory: Path) -> None:
        self._artifact = artifact
        self._target = directory / artifact.name
        self._path = directory / f".{artifact.name}.{artifact.sha256[:16]}.part"

    def __enter__(self) -> Self:
        self._file = self._path.open("ab+")
        self._sha256 = hashlib.sha256()
        self._file.seek(0)
        while portion := self._file.read(READ_BYTES):
            self._sha256.update(portion)
        self.offset = self._file.tell()
        """How many bytes are there."""
        if self.offset > self._artifact.size_bytes:
            self._discard()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._file.close()
        if self.offset == 0:
            self._path.unlink(missing_ok=True)

    @property
    def complete(self) -> bool:
        return self.offset == self._artifact.size_bytes

    def write(self, chunk: bytes) -> None:
        """Append; DownloadCorrupt, and back to nothing, if there are more bytes than announced."""
        if self.offset + len(chunk) > self._artifact.size_bytes:
            self._fail(f"more than {self._artifact.size_bytes} bytes")
        self._file.write(chunk)
        self._sha256.update(chunk)
        self.offset += len(chunk)

    def finish(self) -> Path:
        """Check and move into place.

        Raises:
            ConnectionLost: Bytes are missing; those that came are kept.
            DownloadCorrupt: They are other bytes; back to nothing.
        """
        if not self.complete:
            raise ConnectionLost(
                f"expected {self._artifact.size_bytes} bytes of {self._artifact.name}, got {self.offset}"
            )
        if self._sha256.hexdigest() != self._artifact.sha256:
            self._fail(f"sha256 {self._sha256.hexdigest()}")
        self._file.close()
        os.replace(self._path, self._target)
        return self._target

    def _fail(self, got: str) -> None:
        self._discard()
        raise DownloadCorrupt(
            f"expected {self._artifact.name} of {self._artifact.size_bytes} bytes "
            f"with sha256 {self._artifact.sha256}, got {got}"
        )

    def _discard(self) -> None:
        self._file.truncate(0)
        self._sha256 = hashlib.sha256()
        self.offset = 0


def choose_artifacts(refinement: Refinement, names: Iterable[str] | None) -> list[Artifact]:
    """The artifacts of these names, or all; an error that says why there are none."""
    offered = {artifact.name: artifact for artifact in refinement.artifacts}
    for name in offered:
        if Path(name).name != name or name.startswith(".") or "\0" in name:
            raise ServerError(f"expected artifacts with plain file names from the server, got {name!r}")
    if not offered and not refinement.state.terminal:
        raise Conflict(f"expected a finished refinement, {refinement.id} is {refinement.state}; wait for it")
    if not offered:
        raise NotFound(f"refinement {refinement.id} is {refinement.state} and has no artifacts")
    if names is None:
        return list(offered.values())
    return [offered[name] if name in offered else _not_offered(name, offered) for name in names]


def _not_offered(name: str, offered: Iterable[str]) -> NoReturn:
    near = difflib.get_close_matches(name, offered, n=1, cutoff=0.0)[0]
    raise InvalidInput(
        f"expected the name of an artifact, got {name!r}; did you mean {near}? (of {', '.join(offered)})"
    )
