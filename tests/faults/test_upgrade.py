"""Jobs of an earlier version are run, watched and downloaded by this one; see tests/support/job_dump.py."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

import job_dump
import pytest
from service_process import run_service
from worker_process import Workplace

from refine_jobs import keys
from refine_jobs.embedded import EmbeddedRedis
from refine_proto.formats import ARTIFACTS
from refine_proto.models import EventType, State

if TYPE_CHECKING:
    from worker_process import StartWorker

DUMPS = sorted((Path(__file__).parent / "dumps").glob("*.zip"))


@pytest.mark.parametrize("dump", DUMPS, ids=lambda dump: dump.stem)
def test_jobs_of_an_earlier_version_go_on(dump: Path, tmp_path: Path, start_worker: StartWorker) -> None:
    data = tmp_path / "data"
    with EmbeddedRedis(tmp_path / "redis") as server:
        ids = job_dump.load(dump, server.url, data)
        workplace = Workplace(server.url, data)
        with run_service(server.url, data) as service, service.client("rest") as client:
            assert {state: str(client.get(job_id).state) for state, job_id in ids.items()} == {
                state: state for state in ids
            }
            failure = client.get(ids["failed"]).error
            assert failure
            assert failure.reason == "MESH_INVALID"
            with start_worker(workplace):
                for state in ("running", "queued"):
                    assert client.wait(ids[state]).state is State.SUCCEEDED, client.get(ids[state]).error
            assert client.get(ids["running"]).attempt == 2  # its lease ran out
            with service.client("grpc") as other:
                for state in ("succeeded", "running", "queued"):
                    *_, last = other.watch(ids[state])
                    assert last.type is EventType.COMPLETED
                    files = other.download(ids[state], tmp_path / state)
                    assert set(files) == set(ARTIFACTS)
            for state in ("failed", "cancelled", "succeeded"):
                client.delete(ids[state])
        workplace.redis.close()


def test_a_record_names_no_views_where_there_are_none(workplace: Workplace) -> None:
    """A worker of a version without views refuses the word."""
    spec = json.loads(workplace.redis.hget(keys.JOB + workplace.submit(), "spec"))
    assert set(spec) == {"camera", "options", "mesh_format"}
