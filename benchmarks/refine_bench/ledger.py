"""What clients of an installation were promised, and whether it was kept."""

from __future__ import annotations

import hashlib
import threading
import time
from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from refine_client import RefineClient
from refine_proto.errors import NotFound
from refine_proto.models import Refinement, State


@dataclass
class Ledger:
    """What clients were promised, and when. Shared by threads."""

    accepted: dict[str, str] = field(default_factory=dict)  # id -> idempotency key
    ready_at: list[float] = field(default_factory=list)  # the service said that it takes calls
    ended: dict[str, State] = field(default_factory=dict)  # as a client first saw it
    ended_at: list[float] = field(default_factory=list)
    faults: list[tuple[float, str, str]] = field(default_factory=list)  # time at its end, part, kind
    lock: threading.Lock = field(default_factory=threading.Lock)

    def recoveries(self) -> dict[tuple[str, str], list[float]]:
        """Seconds from the end of a fault until the service is ready (Redis, service) or a job ends."""
        found = defaultdict(list)
        for at, part, kind in self.faults:
            times = self.ready_at if part in ("redis", "service") else self.ended_at
            if after := [time for time in times if time > at]:
                found[part, kind].append(min(after) - at)
        return found


class Verdict:
    """A final look at every job and every byte."""

    def __init__(self, client: RefineClient, ledger: Ledger, folder: Path, settle_s: float) -> None:
        self._client, self._ledger, self._folder = client, ledger, folder
        self._give_up_at = time.monotonic() + settle_s
        self.wrong: list[str] = []
        self._states: Counter[str] = Counter()
        self._reasons: Counter[str] = Counter()
        self._attempts: Counter[int] = Counter()
        self._meshes: Counter[str] = Counter()
        self._artifacts = 0
        for job_id in ledger.accepted:
            self._judge(job_id)
        strangers = set(_all_ids(client)) - set(ledger.accepted)
        self.wrong += [f"doubled: nobody was told of {job_id}" for job_id in sorted(strangers)]
        if len(self._meshes) > 1:  # of the same job on the same device
            self.wrong.append(f"different: refined.glb came out as {len(self._meshes)} different files")

    def _judge(self, job_id: str) -> None:
        try:
            final = self._client.get(job_id)
            while not final.state.terminal and time.monotonic() < self._give_up_at:
                time.sleep(0.5)
                final = self._client.get(job_id)
        except NotFound:
            self.wrong.append(f"lost: {job_id} was accepted and is not there")
            return
        self._states[str(final.state)] += 1
        self._attempts[final.attempt] += 1
        first = self._ledger.ended.get(job_id, final.state)
        if not final.state.terminal:
            self.wrong.append(f"stuck: {job_id} is {final.state}")
        if first is not final.state:
            self.wrong.append(f"changed: {job_id} was {first} and is {final.state}")
        if final.error:
            self._reasons[final.error.reason] += 1
            self.wrong.append(f"failed: {job_id}: {final.error.reason}: {final.error.detail}")
        if final.state is State.SUCCEEDED:
            self._hash(final)

    def _hash(self, final: Refinement) -> None:
        told = {artifact.name: artifact for artifact in final.artifacts}
        for name, path in self._client.download(final.id, self._folder / final.id).items():
            data = path.read_bytes()
            digest = hashlib.sha256(data).hexdigest()
            self._artifacts += 1
            if (digest, len(data)) != (told[name].sha256, told[name].size_bytes):
                self.wrong.append(f"broken: {name} of {final.id}")
            if name == "refined.glb":
                self._meshes[digest] += 1

    def notes(self) -> Iterator[str]:
        """What else there is to say."""
        yield f"final states: {dict(self._states)}, reasons of failures: {dict(self._reasons)}"
        yield f"attempts per job: {dict(sorted(self._attempts.items()))}"
        yield f"artifacts hashed: {self._artifacts}"
        yield f"different refined.glb of the same job: {len(self._meshes)}"


def _all_ids(client: RefineClient) -> Iterator[str]:
    cursor = None
    while True:
        page = client.list(limit=100, cursor=cursor)
        yield from (refinement.id for refinement in page.refinements)
        cursor = page.next_cursor
        if cursor is None:
            return
