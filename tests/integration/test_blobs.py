"""Blobs in a folder and in a bucket of a real S3 API server behave alike."""

from __future__ import annotations

import asyncio
import hashlib
import os
import subprocess
import sys
import time
import urllib.request
from collections.abc import AsyncIterator, Iterator
from pathlib import Path

import pytest

from refine_jobs.blobs import PART_BYTES, Blob, BlobNotFound, BlobStore

BIG = bytes(range(256)) * (3 * PART_BYTES // 256 // 2)  # one and a half parts


@pytest.fixture(scope="module")
def s3_endpoint() -> Iterator[str]:
    from moto.server import ThreadedMotoServer

    server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    yield f"http://{host}:{port}"
    server.stop()


@pytest.fixture(params=["folder", "s3"])
def blobs(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> BlobStore:
    if request.param == "folder":
        return BlobStore(str(tmp_path / "blobs"))
    endpoint: str = request.getfixturevalue("s3_endpoint")
    settings = {
        "AWS_ENDPOINT_URL": endpoint,
        "AWS_ALLOW_HTTP": "true",
        "AWS_ACCESS_KEY_ID": "test",
        "AWS_SECRET_ACCESS_KEY": "test",
        "AWS_REGION": "us-east-1",
    }
    for name, value in settings.items():
        monkeypatch.setenv(name, value)
    bucket = f"refine-{os.urandom(4).hex()}"
    urllib.request.urlopen(urllib.request.Request(f"{endpoint}/{bucket}", method="PUT")).close()
    return BlobStore(f"s3://{bucket}/some/prefix")


async def chunks(data: bytes, size: int = 64 * 1024, fail: bool = False) -> AsyncIterator[bytes]:
    for start in range(0, len(data), size):
        yield data[start : start + size]
    if fail:
        raise ConnectionResetError("the client went away")


async def read(blobs: BlobStore, name: str, start: int = 0, stop: int | None = None) -> bytes:
    return b"".join([chunk async for chunk in blobs.stream(name, start, stop)])


@pytest.mark.parametrize("data", [b"", b"small", BIG], ids=["empty", "small", "big"])
def test_what_is_streamed_in_comes_out(blobs: BlobStore, data: bytes) -> None:
    blob = asyncio.run(blobs.put_stream("jobs/a/input/mesh", chunks(data)))
    assert blob == Blob(len(data), hashlib.sha256(data).hexdigest())
    assert blobs.get("jobs/a/input/mesh") == data
    assert blobs.size_bytes("jobs/a/input/mesh") == len(data)
    assert asyncio.run(read(blobs, "jobs/a/input/mesh")) == data


def test_put_is_put_stream_in_one_piece(blobs: BlobStore) -> None:
    assert blobs.put("a", BIG) == asyncio.run(blobs.put_stream("b", chunks(BIG)))
    assert blobs.get("a") == blobs.get("b") == BIG


@pytest.mark.parametrize(("start", "stop"), [(0, 10), (5, None), (100, 70_000), (len(BIG) - 1, None)])
def test_ranges(blobs: BlobStore, start: int, stop: int | None) -> None:
    blobs.put("a", BIG)
    assert asyncio.run(read(blobs, "a", start, stop)) == BIG[start:stop]


@pytest.mark.parametrize("size", [10, len(BIG)])
def test_an_upload_that_breaks_off_leaves_nothing(blobs: BlobStore, size: int) -> None:
    with pytest.raises(ConnectionResetError):
        asyncio.run(blobs.put_stream("jobs/a/input/mesh", chunks(BIG[:size], fail=True)))
    with pytest.raises(BlobNotFound):
        blobs.get("jobs/a/input/mesh")
    assert blobs.delete_folder("jobs") == 0


def test_folders_and_their_age(blobs: BlobStore) -> None:
    assert blobs.folders("jobs") == []
    blobs.put("jobs/a/input/mesh", b"x")
    blobs.put("jobs/b/1", b"x")
    assert blobs.folders("jobs") == ["a", "b"]
    assert 0 <= time.time() - blobs.changed_at("jobs/a") < 3600
    assert blobs.changed_at("jobs/c") == 0


def test_what_a_killed_process_has_half_written_goes_with_its_folder(tmp_path: Path) -> None:
    code = (
        "import asyncio, os, sys; from refine_jobs.blobs import *\n"
        "async def chunks():\n"
        "    for _ in range(8): yield bytes(WRITE_BYTES)\n"
        "    os._exit(9)\n"
        "asyncio.run(BlobStore(sys.argv[1]).put_stream('jobs/a/input/mesh', chunks()))"
    )
    assert subprocess.run([sys.executable, "-c", code, tmp_path]).returncode == 9
    blobs = BlobStore(str(tmp_path))
    assert blobs.folders("jobs") == ["a"]
    assert blobs.delete_folder("jobs/a") == 0
    assert list(tmp_path.rglob("*")) in ([], [tmp_path / "jobs"])


def test_missing_blobs(blobs: BlobStore) -> None:
    for ask in (blobs.get, blobs.size_bytes):
        with pytest.raises(BlobNotFound):
            ask("jobs/none/input/mesh")
    with pytest.raises(BlobNotFound):
        asyncio.run(read(blobs, "jobs/none/input/mesh"))


def test_a_folder_goes_without_its_neighbours(blobs: BlobStore) -> None:
    for name in ("jobs/a/1", "jobs/a/b/2", "jobs/ab/3"):
        blobs.put(name, b"x")
    assert blobs.delete_folder("jobs/a") == 2
    assert blobs.delete_folder("jobs/a") == 0
    assert blobs.get("jobs/ab/3") == b"x"


def test_a_name_cannot_leave_the_store(blobs: BlobStore) -> None:
    with pytest.raises(ValueError, match=r"\.\."):
        blobs.put("../outside", b"x")


def test_writable(blobs: BlobStore) -> None:
    blobs.check_writable()


def test_a_folder_that_cannot_be_made_says_so(tmp_path: Path) -> None:
    (tmp_path / "blobs").write_text("a file is in the way")
    with pytest.raises(OSError, match=r"a folder for blobs at .*blobs"):
        BlobStore(str(tmp_path / "blobs"))
