"""Full disks: no job fails for one, nothing that was accepted is lost, and callers are told which it is."""

from __future__ import annotations

import os
import signal
import subprocess
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from sample import CAMERA, MESH, SILHOUETTE, form
from service_process import run_service
from worker_process import Workplace, wait_until

from refine_jobs import keys
from refine_jobs.embedded import EmbeddedRedis
from refine_jobs.redis_server import connect
from refine_jobs.slots import SlotState
from refine_proto.errors import Unavailable
from refine_proto.models import State

if TYPE_CHECKING:
    from worker_process import StartWorker


@dataclass(frozen=True)
class Disk:
    """A small one of its own."""

    folder: Path

    def fill(self) -> None:
        with suppress(OSError), (self.folder / "filler").open("ab", buffering=0) as filler:
            while True:
                filler.write(bytes(4096))

    def make_room(self) -> None:
        (self.folder / "filler").unlink()


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Callable[[str, int], Disk]]:
    """Make one of so many MiB."""
    with ExitStack() as mounted:

        def make(name: str, size_mib: int) -> Disk:
            folder = tmp_path / name
            folder.mkdir()
            command = ["mount", "-t", "tmpfs", "-o", f"size={size_mib}m", "tmpfs", str(folder)]
            try:
                done = subprocess.run(command, capture_output=True)
            except OSError as error:
                pytest.skip(f"needs mount: {error}")
            if done.returncode:
                pytest.skip(f"needs the right to mount a tmpfs: {done.stderr.decode()}")
            mounted.callback(subprocess.run, ["umount", "--lazy", str(folder)], check=True)
            return Disk(folder)

        yield make


def test_a_job_waits_while_the_blob_store_is_full(
    disk: Callable[[str, int], Disk], start_worker: StartWorker, redis_server: str
) -> None:
    blobs = disk("blobs", 16)
    workplace = Workplace(redis_server, blobs.folder, pool="full")
    with start_worker(workplace) as worker:
        job_id = workplace.submit(iterations=40)
        workplace.refining(job_id)
        blobs.fill()
        wait_until(lambda: workplace.job(job_id).state is State.QUEUED, "a job that is given back")
        wait_until(lambda: worker.slots()[0].state is SlotState.STARTING, "a slot that takes no job")
        blobs.make_room()
        job = workplace.ended(job_id)
    assert (job.state, job.attempt) == (State.SUCCEEDED, 2), job.error
    assert not workplace.redis.hexists(keys.JOB + job_id, "lost")
    workplace.redis.close()


@pytest.mark.parametrize("transport", ["rest", "grpc"])
def test_uploads_without_room_are_to_be_sent_again(
    disk: Callable[[str, int], Disk],
    redis_server: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    transport: str,
) -> None:
    temporary = disk("tmp", 8)
    monkeypatch.setenv("TMPDIR", str(temporary.folder))
    large = MESH.read_bytes() + b"# padding\n" * 200_000
    with (
        run_service(redis_server, tmp_path / "data") as service,
        service.client(transport) as client,
    ):

        def submit() -> None:
            client.submit(large, SILHOUETTE.read_bytes(), CAMERA, mesh_format="obj")

        submit()
        temporary.fill()
        with pytest.raises(Unavailable, match="temporary folder") as caught:
            submit()
        assert caught.value.retry_after_s
        temporary.make_room()
        submit()


def test_nothing_that_was_accepted_is_lost_with_the_disk_of_redis(
    disk: Callable[[str, int], Disk], tmp_path: Path
) -> None:
    store = disk("redis", 8)
    accepted: list[str] = []
    refused: list[tuple[int, str, str]] = []
    with EmbeddedRedis(store.folder) as server:
        with connect(server.url) as redis:
            pid = redis.info()["process_id"]
        with run_service(server.url, tmp_path / "data") as service, service.rest() as rest:
            store.fill()
            while len(refused) < 3:
                answer = rest.post("/v1/refinements", **form())
                if answer.status_code == 202:
                    accepted.append(answer.json()["id"])
                else:
                    told = (answer.status_code, answer.json()["reason"], answer.headers["Retry-After"])
                    refused.append(told)
                    assert "job store" in answer.json()["detail"]
            assert set(refused) == {(503, "UNAVAILABLE", "5")}
            assert rest.get("/readyz").json()["detail"].startswith("the job store takes no writes")
            assert accepted
            assert rest.get(f"/v1/refinements/{accepted[0]}").json()["state"] == "queued"
            assert rest.post(f"/v1/refinements/{accepted[0]}/cancel").status_code == 503
            os.kill(pid, signal.SIGKILL)
        store.make_room()
    with EmbeddedRedis(store.folder) as server, connect(server.url) as redis:
        assert [job_id for job_id in accepted if not redis.exists(keys.JOB + job_id)] == []
