"""How many threads a command takes: no more than its container allows."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from refine_proto.commands import cores
from refine_proto.commands.cores import usable_cores


@pytest.fixture
def group(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of the control group, on a machine of eight cores."""
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(8)), raising=False)
    monkeypatch.setattr(cores, "CONTROL_GROUP", tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    ("quota", "usable"),
    [
        ("max 100000", 8),
        ("200000 100000", 2),
        ("150000 100000", 1),
        ("50000 100000", 1),
        ("1600000 100000", 8),
    ],
)
def test_the_quota_of_a_container_counts(group: Path, quota: str, usable: int) -> None:
    (group / "cpu.max").write_text(quota + "\n")
    assert usable_cores() == usable


@pytest.mark.parametrize(("quota", "usable"), [("-1", 8), ("300000", 3)])
def test_that_of_the_older_interface_too(group: Path, quota: str, usable: int) -> None:
    (group / "cpu").mkdir()
    (group / "cpu/cpu.cfs_quota_us").write_text(quota + "\n")
    (group / "cpu/cpu.cfs_period_us").write_text("100000\n")
    assert usable_cores() == usable


def test_without_a_container_it_is_the_affinity(group: Path) -> None:
    assert usable_cores() == 8
