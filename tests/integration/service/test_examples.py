"""The examples for curl and for the plain stub, run as they are."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from pathlib import Path

from redis import Redis
from service_process import Hand, Service

from refine_jobs import keys

EXAMPLES = Path(__file__).parents[3] / "examples"
SAMPLE = EXAMPLES / "samples/chair"
REFINED = b"glTF refined"


def work_once(hand: Hand, redis: Redis) -> threading.Thread:
    """Run the next job."""

    def run() -> None:
        deadline = time.monotonic() + 60
        while not redis.zcard(keys.QUEUED):
            assert time.monotonic() < deadline
            time.sleep(0.02)
        [queued] = redis.zrange(keys.QUEUED, 0, 0)
        job = hand.start(str(queued))
        assert job.spec.options.preset == "fast"
        assert hand.blobs.get(keys.input_blob(job.id, keys.MESH)) == (SAMPLE / "coarse.obj").read_bytes()
        hand.report(job, 5)
        hand.finish(job, {"refined.glb": REFINED})

    thread = threading.Thread(target=run)
    thread.start()
    return thread


def test_one_curl_call(service: Service, hand: Hand, redis: Redis) -> None:
    worker = work_once(hand, redis)
    environment = {**os.environ, "REFINE_SERVER": service.rest_url}
    output = subprocess.run([EXAMPLES / "submit.sh"], env=environment, stdout=subprocess.PIPE, check=True)
    worker.join()
    assert output.stdout == REFINED


def test_a_plain_stub(service: Service, hand: Hand, redis: Redis, tmp_path: Path) -> None:
    worker = work_once(hand, redis)
    refined = tmp_path / "refined.glb"
    program = str(EXAMPLES / "grpc_refine.py")
    command = [sys.executable, program, service.grpc_address, str(SAMPLE), str(refined)]
    output = subprocess.run(command, capture_output=True, text=True, check=True)
    worker.join()
    assert refined.read_bytes() == REFINED
    assert output.stdout.splitlines()[-1] == "succeeded 0 %"
    assert "running 50 %" in output.stdout
