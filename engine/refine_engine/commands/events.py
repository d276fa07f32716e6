"""A run in this process in the words of the contract: the events that a server would send of it."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Mapping
from datetime import UTC, datetime

from refine_proto.errors import RefineError
from refine_proto.formats import ARTIFACTS
from refine_proto.models import (
    Artifact,
    Event,
    EventType,
    Refinement,
    RefinementOptions,
    State,
)
from refine_proto.progress import ProgressMeter

from .. import values
from ..contract import judgement_of
from ..estimation.estimate import Candidate
from ..request import Inputs

NEVER = datetime(9999, 12, 31, 23, 59, 59, tzinfo=UTC)  # as certificates say it (RFC 5280)
INTERVAL_S = 0.5  # between two events of progress, as from a server


class RunEvents:
    """Tells `show` of one run. No server gave it an id, so it has the name of its mesh file."""

    def __init__(self, name: str, options: RefinementOptions, show: Callable[[Event], None]) -> None:
        now = datetime.now(UTC)
        self._refinement = Refinement(
            id=name,
            state=State.RUNNING,
            options=options,
            created_at=now,
            started_at=now,
            expires_at=NEVER,
            attempt=1,
        )
        self._show, self._meter = show, ProgressMeter()
        self._sequence, self._told = 0, -INTERVAL_S
        self._estimate: tuple[Candidate, ...] = ()
        self._send(EventType.STATE)

    def read(self, inputs: Inputs) -> None:
        """The inputs were read and checked."""
        self._estimate = inputs.estimate
        self._refinement = self._refinement.model_copy(update={"checks": list(inputs.findings)})

    def report(self, progress: values.Progress) -> None:
        """An iteration has ended; every INTERVAL_S and the last one are told."""
        told = self._meter.read(progress.iteration, progress.total, progress.losses, progress.silhouette_iou)
        self._refinement = self._refinement.model_copy(update={"progress": told})
        now = time.monotonic()
        if progress.iteration == progress.total or now - self._told >= INTERVAL_S:
            self._told = now
            self._send(EventType.PROGRESS)

    def succeeded(self, inputs: Inputs, result: values.Result, artifacts: Mapping[str, bytes]) -> Refinement:
        """The end: these files were made."""
        described = [
            Artifact(
                name=name,
                media_type=ARTIFACTS[name],
                size_bytes=len(data),
                sha256=hashlib.sha256(data).hexdigest(),
            )
            for name, data in artifacts.items()
        ]
        return self._end(
            state=State.SUCCEEDED,
            artifacts=described,
            **dict(judgement_of(inputs.mesh_file, result, self._estimate)),
        )

    def failed(self, error: RefineError) -> None:
        """The end: there is no result."""
        self._end(state=State.FAILED, error=error.problem())

    def _end(self, **changes: object) -> Refinement:
        changes |= {"finished_at": datetime.now(UTC)}
        self._refinement = self._refinement.model_copy(update=changes)
        self._send(EventType.COMPLETED)
        return self._refinement

    def _send(self, kind: EventType) -> None:
        self._sequence += 1
        self._show(
            Event(
                sequence=self._sequence,
                type=kind,
                time=datetime.now(UTC),
                state=self._refinement.state,
                progress=self._refinement.progress if kind is EventType.PROGRESS else None,
                refinement=self._refinement if kind is EventType.COMPLETED else None,
            )
        )
