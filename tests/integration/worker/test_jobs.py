"""Jobs through one warm slot; and nothing that goes wrong with a job costs the slot."""

from __future__ import annotations

import json
import signal
from typing import TYPE_CHECKING

import psutil
import pytest
from rq import Queue
from rq.job import Job as RqJob
from rq.serializers import JSONSerializer

from refine_jobs import delivery, keys
from refine_jobs.record import Task, decode_event
from refine_jobs.redis_server import connect_for_rq
from refine_jobs.slots import SlotState
from refine_proto.formats import ARTIFACTS
from refine_proto.models import EventType, State, Validation

if TYPE_CHECKING:
    from worker_process import Worker, Workplace

    from refine_jobs.record import Job

LONG = 10_000  # iterations; nobody waits for their end


def assert_succeeds(workplace: Workplace, job_id: str) -> Job:
    job = workplace.ended(job_id)
    assert job.state is State.SUCCEEDED, job.error
    return job


def assert_fails(workplace: Workplace, job_id: str, reason: str) -> str:
    """The detail of the error."""
    job = workplace.ended(job_id)
    assert (job.state, job.error and job.error.reason) == (State.FAILED, reason), job.error
    assert job.error
    return job.error.detail


def test_a_job_succeeds_with_all_artifacts(worker: Worker, workplace: Workplace) -> None:
    job_id = workplace.submit(iterations=12, seed=3)
    assert workplace.refining(job_id).slot == worker.slots()[0].name
    assert (worker.slots()[0].state, worker.slots()[0].job_id) == (SlotState.BUSY, job_id)
    job = assert_succeeds(workplace, job_id)
    assert [artifact.name for artifact in job.artifacts] == list(ARTIFACTS)
    for artifact in job.artifacts:
        assert artifact.media_type == ARTIFACTS[artifact.name]
        stored = workplace.blobs.get(keys.artifact_blob(job_id, 1, artifact.name))
        assert artifact.size_bytes == len(stored)
    report = json.loads(workplace.blobs.get(keys.artifact_blob(job_id, 1, "report.json")))
    assert sum(stage["iterations"] for stage in report["config"]["stages"]) == 12
    assert report["config"]["seed"] == 3
    assert job.silhouette_iou is not None
    assert job.silhouette_iou.model_dump() == report["silhouette_iou"]


def test_progress_tells_where_the_job_is(worker: Worker, workplace: Workplace) -> None:
    job_id = workplace.submit(iterations=30)
    job = assert_succeeds(workplace, job_id)
    assert job.started_at is not None
    assert job.finished_at is not None
    stream = workplace.redis.xrange(keys.EVENTS + job_id)
    events = [event for event in map(decode_event, stream) if event and event.type is EventType.PROGRESS]
    assert 2 <= len(events) <= 2 * (job.finished_at - job.started_at).total_seconds() + 1  # the last one
    progress = [event.progress for event in events if event.progress]
    iterations = [p.iteration for p in progress if p.iteration]  # zero while the mesh is fitted as a whole
    assert iterations == sorted(set(iterations))
    assert [p.iteration for p in progress] == [0] * (len(progress) - len(iterations)) + iterations
    for p in progress:
        assert p.total == 30
        assert p.percent == pytest.approx(100 * p.iteration / 30, abs=0.1)
        assert not p.iteration or {"silhouette", "total"} <= set(p.losses)
        assert 0 < p.silhouette_iou < 1
    assert all(p.eta_s is not None for p in progress if p.iteration > 1)
    assert (progress[-1].iteration, progress[-1].eta_s) == (30, 0)


def test_a_second_job_finds_the_engine_warm(worker: Worker, workplace: Workplace) -> None:
    before = worker.engine_pids()
    for _ in range(2):
        assert_succeeds(workplace, workplace.submit(iterations=4))
    assert worker.engine_pids() == before
    assert psutil.pid_exists(before[-1])


def test_logs_carry_the_ids_of_the_request(worker: Worker, workplace: Workplace) -> None:
    job_id = workplace.submit(iterations=4)
    assert_succeeds(workplace, job_id)
    lines = [line for line in worker.logs if line.get("job_id") == job_id]
    assert {"started", "ended"} <= {line["message"] for line in lines}
    for line in lines:
        assert line["request_id"] == workplace.REQUEST_ID
        assert line["trace_id"] == workplace.TRACE_ID
        assert line["slot"] == worker.slots()[0].name


@pytest.mark.parametrize(
    ("mesh", "reason"),
    [
        (b"v 0 0 0\nv nan 0 0\nv 0 1 0\nf 1 2 3\n", "MESH_INVALID"),
        (b"v 90 90 90\nv 91 90 90\nv 90 91 90\nf 1 2 3\n", "OBJECT_OUT_OF_VIEW"),
    ],
)
def test_a_bad_mesh_fails_with_the_engines_reason(
    worker: Worker, workplace: Workplace, mesh: bytes, reason: str
) -> None:
    before = worker.engine_pids()
    assert "expected" in assert_fails(workplace, workplace.submit(mesh), reason)
    assert worker.engine_pids() == before


def test_what_looks_wrong_is_told_and_refused_if_that_was_asked_for(
    worker: Worker, workplace: Workplace
) -> None:
    askew = [1.0, 1.0, 0.0]
    job = assert_succeeds(workplace, workplace.submit(iterations=4, symmetry_normal=askew))
    (finding,) = job.refinement().checks
    assert (finding.code, finding.severity) == ("SYMMETRY_ELSEWHERE", "warning")
    strict = workplace.submit(iterations=4, symmetry_normal=askew, checks="strict")
    assert assert_fails(workplace, strict, "OPTIONS_INVALID").startswith(finding.message)
    unchecked = workplace.submit(iterations=4, symmetry_normal=askew, checks="off")
    assert assert_succeeds(workplace, unchecked).checks == ()


def test_a_question_is_answered_by_the_warm_engine(worker: Worker, workplace: Workplace) -> None:
    """Also where a refinement would be refused; what cannot be read fails as it would."""
    before = worker.engine_pids()
    question = workplace.submit(task=Task.VALIDATE, symmetry_normal=[1.0, 1.0, 0.0], checks="strict")
    job = assert_succeeds(workplace, question)
    validation = Validation.model_validate(job.answer)
    assert not validation.accepted
    assert [finding.code for finding in validation.checks] == ["SYMMETRY_ELSEWHERE"]
    assert 0.5 < validation.silhouette_iou < 0.9
    assert_fails(workplace, workplace.submit(b"v 0 0 0\nf 1 1 1\n", task=Task.VALIDATE), "MESH_INVALID")
    assert worker.engine_pids() == before


def test_files_that_are_gone_fail_the_job(worker: Worker, workplace: Workplace) -> None:
    slot = worker.slot_pid()
    busy = workplace.submit(iterations=LONG)
    job_id = workplace.submit(iterations=4)
    workplace.blobs.delete_folder(keys.blob_folder(job_id))
    workplace.cancel(busy)
    detail = assert_fails(workplace, job_id, "INTERNAL")
    assert "BlobNotFound" in detail
    assert str(workplace.settings.data_folder) not in detail
    assert worker.slot_pid() == slot


def test_a_running_job_is_cancelled_between_iterations(worker: Worker, workplace: Workplace) -> None:
    before = worker.engine_pids()
    job_id = workplace.submit(iterations=LONG)
    workplace.refining(job_id)
    workplace.cancel(job_id)
    assert workplace.ended(job_id).state is State.CANCELLED
    assert_succeeds(workplace, workplace.submit(iterations=4))
    assert worker.engine_pids() == before


def test_an_engine_that_does_not_stop_is_killed(worker: Worker, workplace: Workplace) -> None:
    before = worker.engine_pids()
    job_id = workplace.submit(iterations=LONG)
    workplace.refining(job_id)
    psutil.Process(before[-1]).suspend()
    workplace.cancel(job_id)
    assert workplace.ended(job_id).state is State.CANCELLED
    assert_succeeds(workplace, workplace.submit(iterations=4))
    assert worker.engine_pids()[:-1] == before


def test_an_engine_that_crashes_fails_the_job_and_is_replaced(worker: Worker, workplace: Workplace) -> None:
    slot, before = worker.slot_pid(), worker.engine_pids()
    job_id = workplace.submit(iterations=LONG)
    workplace.refining(job_id)
    psutil.Process(before[-1]).send_signal(signal.SIGSEGV)
    assert "SIGSEGV" in assert_fails(workplace, job_id, "INTERNAL")
    assert_succeeds(workplace, workplace.submit(iterations=4))
    assert worker.slot_pid() == slot
    assert worker.engine_pids()[:-1] == before


def test_an_engine_that_is_killed_before_it_begins_costs_the_job_nothing(
    worker: Worker, workplace: Workplace
) -> None:
    engine = psutil.Process(worker.engine_pids()[-1])
    engine.suspend()  # so that it does not begin
    job_id = workplace.submit(iterations=4)
    workplace.wait_until(lambda: workplace.job(job_id).state is State.RUNNING, "a slot that has the job")
    engine.kill()
    assert assert_succeeds(workplace, job_id).attempt == 2
    assert not workplace.redis.hexists(keys.JOB + job_id, "lost")


def test_a_hang_ends_at_the_deadline(worker: Worker, workplace: Workplace) -> None:
    slot, before = worker.slot_pid(), worker.engine_pids()
    job_id = workplace.submit(iterations=LONG, timeout_s=4)
    workplace.refining(job_id)
    psutil.Process(before[-1]).suspend()
    assert "4 s" in assert_fails(workplace, job_id, "DEADLINE_EXCEEDED")
    assert_succeeds(workplace, workplace.submit(iterations=4))
    assert worker.slot_pid() == slot
    assert not psutil.pid_exists(before[-1])


def test_a_job_that_version_0_1_0_put_into_the_queue_is_run(
    worker: Worker, workplace: Workplace, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It names the task by its path of that version."""
    monkeypatch.setattr(delivery, "TASK", delivery.FORMER_TASK)
    job_id = workplace.submit(iterations=4)
    with connect_for_rq(workplace.environment["REFINE_REDIS_URL"]) as connection:

        def delivered() -> RqJob:
            return RqJob.fetch(f"{job_id}-1", connection=connection, serializer=JSONSerializer)

        before = delivered()
        assert before.func_name == "refine_worker.task.run"
        assert_succeeds(workplace, job_id)
        assert delivered().enqueued_at == before.enqueued_at  # the reaper did not have to do it again


def test_only_our_task_is_run(worker: Worker, workplace: Workplace) -> None:
    slot = worker.slot_pid()
    victim = workplace.settings.data_folder / "victim"
    victim.touch()
    with connect_for_rq(workplace.environment["REFINE_REDIS_URL"]) as connection:
        queue = Queue(keys.queue("default"), connection=connection, serializer=JSONSerializer)
        queue.enqueue("os.remove", str(victim))
    assert_succeeds(workplace, workplace.submit(iterations=4))
    assert victim.exists()
    assert worker.slot_pid() == slot


def test_secrets_stay_where_they_are_needed(worker: Worker, workplace: Workplace) -> None:
    url = workplace.environment["REFINE_REDIS_URL"]
    for process in worker.tree():
        assert url not in " ".join(process.cmdline())
    engine = psutil.Process(worker.engine_pids()[-1])
    assert url not in engine.environ().values()
    assert engine.environ()["OMP_NUM_THREADS"] == engine.environ()["NUMBA_NUM_THREADS"] == "1"
    assert all(url not in json.dumps(line) for line in worker.logs)
