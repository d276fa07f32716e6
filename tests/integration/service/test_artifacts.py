"""The bytes of artifacts, over both transports."""

from __future__ import annotations

import hashlib
import random
from pathlib import Path

import grpc
import httpx
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from service_process import CAMERA, MESH, PNG, Hand, Service

from refine_jobs import keys
from refine_proto.errors import NotFound
from refine_proto.v1 import refine_pb2 as pb
from refine_proto.v1.refine_pb2_grpc import RefinementsStub

DATA = random.Random(1).randbytes(200_000)
ETAG = f'"{hashlib.sha256(DATA).hexdigest()}"'


@pytest.fixture
def refinement_id(service: Service, hand: Hand) -> str:
    with service.client("rest") as client:
        refinement_id = client.submit(MESH, PNG, CAMERA, mesh_format="obj").id
    hand.run(refinement_id, {"refined.glb": DATA, "preview.png": PNG})
    return refinement_id


@pytest.fixture
def path(refinement_id: str) -> str:
    return f"/v1/refinements/{refinement_id}/artifacts/refined.glb"


def test_the_whole(rest: httpx.Client, path: str) -> None:
    answer = rest.get(path)
    assert (answer.status_code, answer.content) == (200, DATA)
    assert {name: answer.headers[name] for name in ("ETag", "Content-Length", "Accept-Ranges")} == {
        "ETag": ETAG,
        "Content-Length": "200000",
        "Accept-Ranges": "bytes",
    }
    assert answer.headers["Content-Type"] == "model/gltf-binary"
    assert answer.headers["Content-Disposition"] == 'attachment; filename="refined.glb"'
    assert answer.headers["X-Content-Type-Options"] == "nosniff"


@pytest.mark.parametrize(
    ("asked", "start", "stop"),
    [
        ("bytes=0-0", 0, 1),
        ("bytes=100-199", 100, 200),
        ("bytes=70000-140000", 70_000, 140_001),
        ("bytes=199999-", 199_999, 200_000),
        ("bytes=5-999999", 5, 200_000),
        ("bytes=-10", 199_990, 200_000),
        ("bytes=-999999", 0, 200_000),
    ],
)
def test_a_part(rest: httpx.Client, path: str, asked: str, start: int, stop: int) -> None:
    answer = rest.get(path, headers={"Range": asked})
    assert (answer.status_code, answer.content) == (206, DATA[start:stop])
    assert answer.headers["Content-Range"] == f"bytes {start}-{stop - 1}/200000"
    assert answer.headers["ETag"] == ETAG


@pytest.mark.parametrize("asked", ["bytes=0-1,5-6", "lines=1-2", "bytes=9-3", "bytes=", "bytes=a-b"])
def test_ranges_that_are_ignored(rest: httpx.Client, path: str, asked: str) -> None:
    assert rest.get(path, headers={"Range": asked}).content == DATA


@pytest.mark.parametrize("asked", ["bytes=200000-", "bytes=300000-300001", "bytes=-0"])
def test_ranges_outside(rest: httpx.Client, path: str, asked: str) -> None:
    answer = rest.get(path, headers={"Range": asked})
    assert (answer.status_code, answer.json()["reason"]) == (416, "RANGE_NOT_SATISFIABLE")
    assert answer.headers["Content-Range"] == "bytes */200000"


NUMBERS = st.integers(0, 3) | st.integers(199_998, 200_002) | st.integers(0, 10**18 - 1)
RANGES = (
    st.builds("bytes={}-{}".format, NUMBERS, NUMBERS)
    | st.builds("bytes={}-".format, NUMBERS)
    | st.builds("bytes=-{}".format, NUMBERS)
    | st.text("bytes=0123456789-,", max_size=12).map(lambda rest: f"bytes={rest}")
)


def by_the_standard(asked: str) -> range | None:
    """RFC 9110 section 14.1.2: the bytes asked for, empty for none of these; None: no valid single range."""
    first, dash, last = asked.removeprefix("bytes=").partition("-")
    if not dash or not (first + last).isdecimal():
        return None
    if not first:
        return range(max(0, len(DATA) - int(last)), len(DATA))
    if last and int(last) < int(first):
        return None
    return range(int(first), min(int(last) + 1 if last else len(DATA), len(DATA)))


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])  # nothing changes what they hold
@given(asked=RANGES)
def test_any_range(rest: httpx.Client, path: str, asked: str) -> None:
    answer, wanted = rest.get(path, headers={"Range": asked}), by_the_standard(asked)
    if wanted is None:
        assert (answer.status_code, answer.content) == (200, DATA)
    elif not wanted:
        assert (answer.status_code, answer.headers["Content-Range"]) == (416, "bytes */200000")
    else:
        assert (answer.status_code, answer.content) == (206, DATA[wanted.start : wanted.stop])
        assert answer.headers["Content-Range"] == f"bytes {wanted.start}-{wanted.stop - 1}/200000"


def test_conditions(rest: httpx.Client, path: str) -> None:
    for tags in (ETAG, f'"other", W/{ETAG}', "*"):
        answer = rest.get(path, headers={"If-None-Match": tags})
        assert (answer.status_code, answer.content, answer.headers["ETag"]) == (304, b"", ETAG)
    assert rest.get(path, headers={"If-None-Match": '"other"'}).status_code == 200
    part = {"Range": "bytes=0-9"}
    assert rest.get(path, headers={**part, "If-Range": ETAG}).content == DATA[:10]
    assert rest.get(path, headers={**part, "If-Range": '"other"'}).content == DATA


def test_head_is_get_without_the_bytes(rest: httpx.Client, path: str) -> None:
    got, answer = rest.get(path), rest.head(path, headers={"Range": "bytes=0-9"})
    own = ("date", "x-request-id")
    kept = [{k: v for k, v in each.headers.items() if k not in own} for each in (got, answer)]
    assert (answer.status_code, answer.content) == (200, b"")
    assert kept[0] == kept[1]
    assert answer.headers["Content-Length"] == "200000"
    assert rest.head(path, headers={"If-None-Match": ETAG}).status_code == 304


def test_over_grpc(service: Service, refinement_id: str) -> None:
    with grpc.insecure_channel(service.grpc_address) as channel:
        stub = RefinementsStub(channel)
        request = pb.DownloadArtifactRequest(id=refinement_id, name="refined.glb")
        first, *rest = stub.DownloadArtifact(request)
        assert (first.artifact.name, first.artifact.sha256) == ("refined.glb", ETAG.strip('"'))
        assert b"".join(chunk.data for chunk in rest) == DATA
        assert max(len(chunk.data) for chunk in rest) <= 64 * 1024
        request.offset_bytes = 150_000
        _, *rest = stub.DownloadArtifact(request)
        assert b"".join(chunk.data for chunk in rest) == DATA[150_000:]
        request.offset_bytes = 200_001
        with pytest.raises(grpc.RpcError) as caught:
            list(stub.DownloadArtifact(request))
    assert caught.value.code() is grpc.StatusCode.OUT_OF_RANGE


@pytest.mark.parametrize("transport", ["rest", "grpc"])
def test_the_sdk_gets_identical_bytes(
    service: Service, refinement_id: str, transport: str, tmp_path: Path
) -> None:
    with service.client(transport) as client:
        files = client.download(refinement_id, tmp_path)
    assert {name: path.read_bytes() for name, path in files.items()} == {
        "refined.glb": DATA,
        "preview.png": PNG,
    }


def test_what_is_not_there(service: Service, rest: httpx.Client, refinement_id: str, hand: Hand) -> None:
    folder = f"/v1/refinements/{refinement_id}/artifacts"
    for name in ("report.json", "..%2f..%2finput%2fmesh", "%00"):
        answer = rest.get(f"{folder}/{name}")
        assert (answer.status_code, answer.json()["reason"]) == (404, "NOT_FOUND")
        assert rest.head(f"{folder}/{name}").status_code == 404
    with grpc.insecure_channel(service.grpc_address) as channel:
        request = pb.DownloadArtifactRequest(id=refinement_id, name="report.json")
        with pytest.raises(grpc.RpcError) as caught:
            list(RefinementsStub(channel).DownloadArtifact(request))
    assert caught.value.code().name == NotFound("").status.grpc
    hand.blobs.delete_folder(keys.blob_folder(refinement_id))
    assert rest.get(f"{folder}/refined.glb").status_code == 410
    assert rest.head(f"{folder}/refined.glb").status_code == 410
