"""`refine bench --server` against the whole server: the same cases, through the front door."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from sample import SAMPLE
from serve_process import Served

from refine_bench.command import bench_command


@pytest.mark.parametrize(("scheme", "cases"), [("http", ["airplane", "mug"]), ("grpc", ["airplane"])])
def test_cases_through_the_server(served: Served, tmp_path: Path, scheme: str, cases: list[str]) -> None:
    url = served.url if scheme == "http" else f"grpc://{served.grpc_address}"
    chosen = [argument for case in cases for argument in ("--case", case)]
    arguments = ["folder", str(SAMPLE.parent), *chosen, "--preset", "fast", "--threads", "1"]
    assert bench_command([*arguments, "--server", url, "--in-flight", "2", "-o", str(tmp_path)]) == 0

    results = [json.loads(line) for line in (tmp_path / "results.jsonl").read_text().splitlines()]
    assert sorted(line["case"] for line in results) == cases
    for line in results:
        assert line["status"] == "done"
        assert line["after"]["silhouette_iou"] > line["before"]["silhouette_iou"]
        assert len(line["loss_curve"]) > 10
    throughput = json.loads((tmp_path / "throughput.json").read_text())
    assert throughput["refinements"] == len(cases)
    assert throughput["refinements_per_minute"] > 0
    assert 0 <= throughput["queue_s_median"] <= throughput["queue_s_max"]
    assert throughput["running_s_mean"] <= throughput["wall_s"]
