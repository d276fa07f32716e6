"""How much memory a worker plans with: no more than its container allows."""

from __future__ import annotations

from pathlib import Path

import pytest

from refine_worker import host_memory
from refine_worker.host_memory import usable_memory_bytes


@pytest.mark.parametrize("name", ["memory.max", "memory/memory.limit_in_bytes"])
def test_the_limit_of_a_container_counts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    monkeypatch.setattr(host_memory, "CONTROL_GROUP", tmp_path)
    machine = usable_memory_bytes()
    limit = tmp_path / name
    limit.parent.mkdir(exist_ok=True)
    for written, usable in (("1048576\n", 2**20), (f"{2 * machine}\n", machine), ("max\n", machine)):
        limit.write_text(written)
        assert usable_memory_bytes() == usable
