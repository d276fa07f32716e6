"""Where the time of one job goes: python benchmarks/overhead.py [JOBS]

Starts a Redis, a service and a worker with one warm slot, sends jobs of 20 iterations one after the other,
and prints the median of each part. The overhead is all but the fit and the network.
"""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import httpx
import torch
from prometheus_client.parser import text_string_to_metric_families

from refine_client import RefineClient
from refine_engine.artifacts.make import make_artifacts
from refine_engine.contract import config_of
from refine_engine.request import Inputs, check_files
from refine_engine.values import Progress
from refine_jobs.blobs import BlobStore
from refine_proto.models import RefinementOptions, RefinementSpec
from service import CAMERA, SAMPLE, SILHOUETTE, Installation, environment, installation

PORT = "8017"
OPTIONS = {"iterations": 20}


@contextmanager
def one_slot(service: Installation) -> Iterator[None]:
    """A worker with metrics and one slot while inside; it is warm after its first job."""
    values = {
        **environment(service.redis_url, service.folder),
        "REFINE_SLOTS_PER_DEVICE": "1",
        "REFINE_WORKER_PORT": PORT,
    }
    with (service.folder / "worker.log").open("w") as log:
        worker = subprocess.Popen([sys.executable, "-m", "refine_worker"], env=values, stdout=log, stderr=log)
        try:
            yield
        finally:
            worker.terminate()
            worker.wait()


def stage_sums(jobs: int) -> dict[str, float]:
    """Seconds of each stage so far, once the worker has told of so many jobs."""
    while True:
        text = httpx.get(f"http://127.0.0.1:{PORT}/metrics").text
        samples = [s for family in text_string_to_metric_families(text) for s in family.samples]
        stages = [s for s in samples if s.name.startswith("refine_worker_stage_seconds_")]
        if sum(s.value for s in stages if s.name.endswith("_count") and s.labels["stage"] == "store") >= jobs:
            return {s.labels["stage"]: s.value for s in stages if s.name.endswith("_sum")}
        time.sleep(0.05)


def run_job(client: RefineClient, folder: Path, before: Mapping[str, float], jobs: int) -> dict[str, float]:
    """The parts of one job, seconds."""
    started = time.perf_counter()
    sent = client.submit(SAMPLE / "coarse.obj", SILHOUETTE, CAMERA, OPTIONS)
    accepted = time.perf_counter()
    ended = client.wait(sent.id, timeout_s=600)
    took = time.perf_counter() - started
    assert ended.started_at, ended.error
    assert ended.finished_at
    files = client.download(sent.id, folder / sent.id)
    optimised = json.loads(files["report.json"].read_text())["seconds"]
    stages = {stage: total - before.get(stage, 0) for stage, total in stage_sums(jobs).items()}
    queued = (ended.started_at - ended.created_at).total_seconds()
    ran = (ended.finished_at - ended.started_at).total_seconds()
    writing = time.perf_counter()
    for name, file in files.items():
        BlobStore(str(folder / "again")).put(f"{sent.id}/{name}", file.read_bytes())
    store = time.perf_counter() - writing
    return {
        "edge": accepted - started,
        "queue": queued,
        "slot": ran - sum(stages.values()),
        "fetch": stages["fetch"],
        "read": stages["read"],
        "optimisation": optimised,
        "rest of the refinement": stages["refine"] - optimised,
        "artifacts": stages["store"] - store,
        "store": store,
        "news of the end": took - (accepted - started) - queued - ran,
    }


def read_sample() -> Inputs:
    spec = RefinementSpec.model_validate({"camera": CAMERA})
    return check_files((SAMPLE / "coarse.obj").read_bytes(), "mesh.obj", SILHOUETTE, spec.camera)


def share_of_the_fit() -> tuple[float, float]:
    """The part of the optimisation before the network's first iteration; CPU seconds of the artifacts."""
    inputs, config = read_sample(), config_of(RefinementOptions.model_validate(OPTIONS))
    fitted: list[float] = []

    def note(progress: Progress) -> None:
        if progress.losses and not fitted:
            fitted.append(time.perf_counter())

    for _ in range(2):  # the first compiles
        fitted.clear()
        started = time.perf_counter()
        result = inputs.refine(config, torch.device("cpu"), note, lambda: False)
        share = (fitted[0] - started) / (time.perf_counter() - started) if fitted else 1.0
    cpu = []
    for _ in range(5):
        before = time.process_time()
        make_artifacts(inputs, result, config)
        cpu.append(time.process_time() - before)
    return share, statistics.median(cpu)


def main() -> None:
    torch.set_num_threads(1)
    jobs = int(sys.argv[1]) if len(sys.argv) > 1 else 10
    spans: dict[str, list[float]] = {}
    with installation() as service, one_slot(service), RefineClient(service.rest) as client:
        sums: dict[str, float] = {}
        for number in range(jobs + 1):
            parts = run_job(client, service.folder, sums, number + 1)
            sums = stage_sums(number + 1)
            for part, seconds in parts.items() if number else ():  # the first pays the start of the worker
                spans.setdefault(part, []).append(seconds)
    ms = {part: 1000 * statistics.median(seconds) for part, seconds in spans.items()}
    share, artifacts_s = share_of_the_fit()
    optimised = ms.pop("optimisation")
    print(f"| part, medians of {jobs} jobs | ms |\n|---|---:|")
    for part, value in ms.items():
        print(f"| {part} | {value:.0f} |")
    print(f"| **overhead** | **{sum(ms.values()):.0f}** |")
    print(f"| fit | {share * optimised:.0f} |")
    print(f"| network, {OPTIONS['iterations']} iterations | {(1 - share) * optimised:.0f} |")
    load = os.getloadavg()[0]
    print(f"\nCPU time of the artifacts: {1000 * artifacts_s:.0f} ms; load of the machine: {load:.1f}")


if __name__ == "__main__":
    main()
