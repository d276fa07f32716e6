"""What a slot and its engine process say to each other: JSON over a pipe, so nobody unpickles.

slot                      engine
      <- Ready                    once, after the warm-up
Run   ->
      <- PhaseStarted, Progressed ...
Cancel ->                         at any time while it runs
      <- Done, Answered, Failed or Returned once for each Run
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum
from multiprocessing.connection import Connection
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter

from refine_jobs.record import Task
from refine_proto.models import Artifact, CameraEstimate, Finding, Judgement, Progress, Validation

MAX_BYTES = 2**20  # of one message; files go through the blob store


class Phase(StrEnum):
    """What the engine is doing with a job."""

    FETCH = "fetch"  # the files from the blob store
    READ = "read"  # parse and check them: the only untrusted bytes
    REFINE = "refine"
    STORE = "store"  # make the artifacts and put them into the blob store


class _Message(BaseModel):
    model_config = ConfigDict(frozen=True, allow_inf_nan=False)  # JSON would say null


class Run(_Message):
    """Do the task with the files of a job. `spec` is the record's RefinementSpec, to be read again."""

    type: Literal["run"] = "run"
    job_id: str
    attempt: int
    task: Task = Task.REFINE
    spec: Mapping[str, Any]
    more_files: tuple[str, ...] = ()  # beside the mesh and the silhouette: ignore, silhouette_2, ...
    log_fields: dict[str, str] = {}


class Cancel(_Message):
    """Stop after the current iteration."""

    type: Literal["cancel"] = "cancel"


class Ready(_Message):
    """Loaded and compiled."""

    type: Literal["ready"] = "ready"
    seconds: float
    gpu_uuid: str | None = None  # of the card that it computes on


class PhaseStarted(_Message):
    type: Literal["phase_started"] = "phase_started"
    phase: Phase


class Progressed(_Message):
    type: Literal["progressed"] = "progressed"
    progress: Progress


class Done(_Message):
    """The artifacts are in the blob store."""

    type: Literal["done"] = "done"
    artifacts: tuple[Artifact, ...]
    judgement: Judgement
    checks: tuple[Finding, ...] = ()


class Answered(_Message):
    """The answer to a question."""

    type: Literal["answered"] = "answered"
    answer: Validation | CameraEstimate


class Failed(_Message):
    """No result; `reason` is one of refine_proto.errors."""

    type: Literal["failed"] = "failed"
    reason: str
    detail: str
    replace_engine: bool = False  # the process may be damaged


class Returned(_Message):
    """No result, through no fault of the job: the blob store is full or away. `why` is for the log."""

    type: Literal["returned"] = "returned"
    why: str


ToEngine = Run | Cancel
FromEngine = Ready | PhaseStarted | Progressed | Done | Answered | Failed | Returned
_TO_ENGINE: TypeAdapter[ToEngine] = TypeAdapter(Annotated[ToEngine, Field(discriminator="type")])
_FROM_ENGINE: TypeAdapter[FromEngine] = TypeAdapter(Annotated[FromEngine, Field(discriminator="type")])


def send(connection: Connection, message: ToEngine | FromEngine) -> None:
    """Raises OSError when the other side is gone."""
    connection.send_bytes(message.model_dump_json(exclude_none=True).encode())


def receive_in_slot(connection: Connection) -> FromEngine:
    """Wait for a message of the engine; raises EOFError or OSError when it is gone."""
    return _FROM_ENGINE.validate_json(connection.recv_bytes(MAX_BYTES))


def receive_in_engine(connection: Connection) -> ToEngine:
    """Wait for a message of the slot; raises EOFError or OSError when it is gone."""
    return _TO_ENGINE.validate_json(connection.recv_bytes(MAX_BYTES))
