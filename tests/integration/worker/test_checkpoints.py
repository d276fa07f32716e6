"""Checkpoints in the blob store: whose are taken, and when they go."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
import torch

from refine_engine.errors import Diverged
from refine_jobs import keys
from refine_jobs.blobs import BlobNotFound, BlobStore
from refine_worker.engine.checkpoints import BlobCheckpoints, checkpoints_of

CPU = torch.device("cpu")
SNAPSHOT = {"iteration": 7, "network": {"weight": torch.arange(3.0)}}


@pytest.fixture
def blobs(tmp_path: Path) -> BlobStore:
    return BlobStore(str(tmp_path / "blobs"))


def test_what_was_kept_comes_back(blobs: BlobStore) -> None:
    assert BlobCheckpoints(blobs, "job", CPU, 1).last() is None
    BlobCheckpoints(blobs, "job", CPU, 1).keep(SNAPSHOT)
    found = BlobCheckpoints(blobs, "job", CPU, 1).last()
    assert found is not None
    assert found["iteration"] == 7
    assert torch.equal(found["network"]["weight"], torch.arange(3.0))
    assert BlobCheckpoints(blobs, "other", CPU, 1).last() is None


@pytest.mark.parametrize("word", [b"threads ", b"torch 2", b"code "])
def test_what_another_engine_has_kept_is_left_alone(blobs: BlobStore, word: bytes) -> None:
    """Its result would be another one."""
    BlobCheckpoints(blobs, "job", CPU, 1).keep(SNAPSHOT)
    data = blobs.get(keys.checkpoint_blob("job"))
    assert word in data
    blobs.put(keys.checkpoint_blob("job"), data.replace(word, bytes(reversed(word))))
    assert BlobCheckpoints(blobs, "job", CPU, 1).last() is None


@pytest.mark.parametrize("error", [None, Diverged("it did")])
def test_a_checkpoint_goes_with_its_run(blobs: BlobStore, error: Exception | None) -> None:
    assert isinstance(run(blobs, error), type(error))
    with pytest.raises(BlobNotFound):
        blobs.get(keys.checkpoint_blob("job"))


def test_a_checkpoint_outlives_a_run_that_was_interrupted(blobs: BlobStore) -> None:
    assert run(blobs, OSError("the blob store is away"))
    assert blobs.size_bytes(keys.checkpoint_blob("job"))


def run(blobs: BlobStore, error: Exception | None) -> Exception | None:
    """One that keeps a checkpoint and ends so; what comes out."""
    try:
        with checkpoints_of(blobs, "job", CPU, 1) as checkpoints:
            checkpoints.keep(SNAPSHOT)
            if error:
                raise error
    except Exception as raised:
        return raised
    return None


def test_a_blob_store_without_room_costs_the_checkpoint_and_not_the_run(
    blobs: BlobStore, tmp_path: Path
) -> None:
    shutil.rmtree(tmp_path / "blobs")
    (tmp_path / "blobs").write_text("in the way")
    checkpoints = BlobCheckpoints(blobs, "job", CPU, 0.001)
    checkpoints.keep(SNAPSHOT)
