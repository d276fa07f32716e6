"""Immutable bytes by name, in a local folder or an S3-compatible bucket.

A blob appears whole or not at all. obstore's synchronous calls do the work, in threads where the service
needs them: its asynchronous ones (0.12) abort the interpreter when the process ends soon after.
"""

from __future__ import annotations

import asyncio
import hashlib
import shutil
import uuid
from collections.abc import AsyncGenerator, AsyncIterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import obstore
from obstore.exceptions import BaseError
from obstore.store import LocalStore, ObjectStore, S3Store

CHUNK_BYTES = 64 * 1024
# S3 takes parts of at least 5 MiB; one part at a time bounds the memory of an upload.
PART_BYTES = 5 * 1024 * 1024
WRITE_BYTES = 1024 * 1024  # goes to a thread at once


@dataclass(frozen=True)
class Blob:
    """What is known of stored bytes."""

    size_bytes: int
    sha256: str


@dataclass(frozen=True)
class Space:
    """Of the disk on which blobs lie."""

    size_bytes: int
    free_bytes: int


class BlobNotFound(Exception):
    """No blob of this name."""


class BlobStoreFailed(Exception):
    """The store is full or away, through no fault of what was asked of it."""


@contextmanager
def _failing_as_one() -> Iterator[None]:
    """Tell the errors of folders and buckets as BlobStoreFailed; that something is not there passes."""
    try:
        yield
    except FileNotFoundError:
        raise
    except (OSError, BaseError) as error:
        raise BlobStoreFailed(f"the blob store failed: {error}") from error


class BlobStore:
    """Blobs below `location`: a folder, made if needed, or `s3://bucket/prefix`.

    All that reads or writes raises BlobStoreFailed.
    """

    def __init__(self, location: str) -> None:
        self._store: ObjectStore
        self._folder = None if location.startswith("s3://") else location
        if self._folder is None:
            self._store = S3Store.from_url(location, virtual_hosted_style_request=False)
        else:
            try:
                self._store = LocalStore(location, mkdir=True, automatic_cleanup=True)
            except OSError as error:
                raise OSError(f"expected a folder for blobs at {location}, got: {error}") from error

    def put(self, name: str, data: bytes) -> Blob:
        """Store `data`."""
        with _failing_as_one():
            obstore.put(self._store, name, data, chunk_size=PART_BYTES, max_concurrency=1)
        return Blob(len(data), hashlib.sha256(data).hexdigest())

    async def put_stream(self, name: str, chunks: AsyncIterable[bytes]) -> Blob:
        """Store the bytes of `chunks`; if the iterator raises, nothing is stored."""
        digest, size = hashlib.sha256(), 0
        pending = bytearray()
        writer = None
        async for chunk in chunks:
            digest.update(chunk)
            size += len(chunk)
            pending += chunk
            if len(pending) >= WRITE_BYTES:
                writer = writer or obstore.open_writer(
                    self._store, name, buffer_size=PART_BYTES, max_concurrency=1
                )
                with _failing_as_one():
                    await asyncio.to_thread(writer.write, bytes(pending))
                pending.clear()
        with _failing_as_one():
            if writer is None:
                await asyncio.to_thread(obstore.put, self._store, name, bytes(pending))
            else:
                await asyncio.to_thread(writer.write, bytes(pending))
                await asyncio.to_thread(writer.close)
        return Blob(size, digest.hexdigest())

    def get(self, name: str) -> bytes:
        """All bytes; raises BlobNotFound."""
        try:
            with _failing_as_one():
                return bytes(obstore.get(self._store, name).bytes())
        except FileNotFoundError:
            raise BlobNotFound(name) from None

    def size_bytes(self, name: str) -> int:
        """Number of bytes; raises BlobNotFound."""
        try:
            with _failing_as_one():
                return int(obstore.head(self._store, name)["size"])
        except FileNotFoundError:
            raise BlobNotFound(name) from None

    async def stream(self, name: str, start: int = 0, stop: int | None = None) -> AsyncGenerator[bytes, None]:
        """Bytes from `start` to before `stop` (default: the end) in chunks; raises BlobNotFound first."""
        chunks = await asyncio.to_thread(self._open, name, start, stop)
        while (chunk := await asyncio.to_thread(_next, chunks)) is not None:
            yield bytes(chunk)

    def _open(self, name: str, start: int, stop: int | None) -> Iterator[bytes]:
        size = self.size_bytes(name)
        stop = size if stop is None else min(stop, size)
        if start >= stop:
            return iter(())
        with _failing_as_one():
            result = obstore.get(self._store, name, options={"range": (start, stop)})
        return iter(result.stream(min_chunk_size=CHUNK_BYTES))

    def delete_folder(self, folder: str) -> int:
        """Delete every blob below `folder`; how many there were. Safe to repeat."""
        names = [found["path"] for batch in obstore.list(self._store, folder) for found in batch]
        for name in names:
            try:
                obstore.delete(self._store, name)
            except FileNotFoundError:
                continue  # somebody else was faster
        if self._folder is not None:  # what killed processes have half-written is not listed
            shutil.rmtree(Path(self._folder, folder), ignore_errors=True)
        return len(names)

    def folders(self, parent: str) -> list[str]:
        """Names of the folders in `parent`, half-written blobs or not."""
        if self._folder is not None:
            place = Path(self._folder, parent)
            return sorted(path.name for path in place.iterdir()) if place.exists() else []
        found = obstore.list_with_delimiter(self._store, parent)["common_prefixes"]
        return sorted(prefix.rstrip("/").rpartition("/")[2] for prefix in found)

    def changed_at(self, folder: str) -> float:
        """When something below `folder` was last written, in seconds since 1970; 0 if nothing is there."""
        if self._folder is not None:
            return max(_mtimes(Path(self._folder, folder)), default=0.0)
        found = (blob for batch in obstore.list(self._store, folder) for blob in batch)
        return max((blob["last_modified"].timestamp() for blob in found), default=0.0)

    def space(self) -> Space | None:
        """Of the file system; None for a bucket, which has no bound. Raises OSError."""
        if self._folder is None:
            return None
        usage = shutil.disk_usage(self._folder)
        return Space(usage.total, usage.free)

    def check_writable(self) -> None:
        """Write and delete a probe."""
        probe = f"probe/{uuid.uuid4().hex}"  # its own name: other processes probe too
        with _failing_as_one():
            obstore.put(self._store, probe, b"probe")
            obstore.delete(self._store, probe)


def _mtimes(folder: Path) -> Iterator[float]:
    for path in (folder, *folder.rglob("*")):
        with suppress(FileNotFoundError):  # it went meanwhile
            yield path.stat().st_mtime


def _next(chunks: Iterator[bytes]) -> bytes | None:
    with _failing_as_one():
        return next(chunks, None)
