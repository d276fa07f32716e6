"""Downloads are whole, checked, and continued where they stopped."""

from __future__ import annotations

from pathlib import Path

import pytest
from faces import Face
from server_double import ARTIFACTS, Script

from refine_client import ConnectionLost, DownloadCorrupt
from refine_proto import errors
from refine_proto.models import State

GLB = ARTIFACTS["refined.glb"]


def test_all_artifacts_or_some(face: Face, tmp_path: Path) -> None:
    files = face.call("download", "job-1", tmp_path / "all")
    assert {name: path.read_bytes() for name, path in files.items()} == ARTIFACTS
    files = face.call("download", "job-1", tmp_path / "some", ["report.json"])
    assert files == {"report.json": tmp_path / "some/report.json"}
    assert [path.name for path in (tmp_path / "some").iterdir()] == ["report.json"]


def test_a_dropped_download_goes_on_where_it_was(face: Face, script: Script, tmp_path: Path) -> None:
    script.drop_download_after = [100_000, 200_000]
    files = face.call("download", "job-1", tmp_path, ["refined.glb"])
    assert files["refined.glb"].read_bytes() == GLB
    offsets = [call.detail for call in script.seen("download")]
    assert (offsets[0], len(offsets)) == (0, 3)
    assert offsets == sorted(offsets)
    assert offsets[1] <= 100_000
    assert offsets[2] <= 200_000


def test_a_later_call_goes_on_where_an_earlier_one_failed(face: Face, script: Script, tmp_path: Path) -> None:
    part = tmp_path / f".refined.glb.{script.refinement(State.SUCCEEDED).artifacts[0].sha256[:16]}.part"
    part.write_bytes(GLB[:100_000])
    files = face.call("download", "job-1", tmp_path, ["refined.glb"])
    assert files["refined.glb"].read_bytes() == GLB
    assert [call.detail for call in script.seen("download")] == [100_000]
    assert list(tmp_path.iterdir()) == [tmp_path / "refined.glb"]


def test_what_is_left_of_other_bytes_is_fetched_anew(face: Face, script: Script, tmp_path: Path) -> None:
    part = tmp_path / f".refined.glb.{script.refinement(State.SUCCEEDED).artifacts[0].sha256[:16]}.part"
    part.write_bytes(bytes(100_000))
    assert face.call("download", "job-1", tmp_path, ["refined.glb"])["refined.glb"].read_bytes() == GLB
    assert [call.detail for call in script.seen("download")] == [100_000, 0]


@pytest.mark.parametrize("size", [len(GLB), len(GLB) + 1])
def test_what_is_left_may_be_whole_or_too_long(face: Face, script: Script, tmp_path: Path, size: int) -> None:
    part = tmp_path / f".refined.glb.{script.refinement(State.SUCCEEDED).artifacts[0].sha256[:16]}.part"
    part.write_bytes((GLB + b"!")[:size])
    assert face.call("download", "job-1", tmp_path, ["refined.glb"])["refined.glb"].read_bytes() == GLB
    assert len(script.seen("download")) == size - len(GLB)


def test_wrong_bytes_are_fetched_again(face: Face, script: Script, tmp_path: Path) -> None:
    script.corrupt_downloads = 2
    assert face.call("download", "job-1", tmp_path, ["refined.glb"])["refined.glb"].read_bytes() == GLB
    assert [call.detail for call in script.seen("download")] == [0, 0, 0]


def test_wrong_bytes_never_appear(face: Face, script: Script, tmp_path: Path) -> None:
    script.corrupt_downloads = 9
    (tmp_path / "refined.glb").write_bytes(b"of an earlier refinement")
    with pytest.raises(DownloadCorrupt, match=r"expected refined\.glb of 262144 bytes with sha256"):
        face.call("download", "job-1", tmp_path, ["refined.glb"])
    assert (tmp_path / "refined.glb").read_bytes() == b"of an earlier refinement"
    assert list(tmp_path.iterdir()) == [tmp_path / "refined.glb"]


def test_giving_up_keeps_what_came(face: Face, script: Script, tmp_path: Path) -> None:
    script.drop_download_after = [50_000] * 9
    with pytest.raises(ConnectionLost):
        face.call("download", "job-1", tmp_path, ["refined.glb"])
    assert not (tmp_path / "refined.glb").exists()
    script.drop_download_after = []
    assert face.call("download", "job-1", tmp_path, ["refined.glb"])["refined.glb"].read_bytes() == GLB


def test_unknown_names_name_the_nearest(face: Face, tmp_path: Path) -> None:
    with pytest.raises(errors.InvalidInput, match=r"did you mean refined\.glb\?"):
        face.call("download", "job-1", tmp_path, ["refine.glb"])


@pytest.mark.parametrize(
    ("state", "error"), [(State.RUNNING, errors.Conflict), (State.CANCELLED, errors.NotFound)]
)
def test_no_artifacts_says_why(
    face: Face, script: Script, tmp_path: Path, state: State, error: type[errors.RefineError]
) -> None:
    script.ends_in = state
    with pytest.raises(error, match=state):
        face.call("download", "job-1", tmp_path)


@pytest.mark.parametrize("name", ["../evil", "/etc/evil", ".bashrc", "a/b", ".."])
def test_a_server_cannot_choose_where_files_go(
    face: Face, script: Script, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    monkeypatch.setitem(ARTIFACTS, name, b"evil")
    with pytest.raises(errors.RefineError, match="plain file names"):
        face.call("download", "job-1", tmp_path / "out")
    assert not script.seen("download")
