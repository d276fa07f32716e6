"""What the record of a job carries unread: an older service or slot passes on what a newer one took."""

from __future__ import annotations

import json
from typing import Any

from refine_jobs.record import Job
from refine_proto.models import State

SPEC: dict[str, Any] = {
    "camera": {"type": "fisheye", "strength": 3},
    "options": {"preset": "fast", "seed": 3, "timeout_s": 60.0, "brand_new": True},
    "mesh_format": "usd",
}
FIELDS = {
    "id": "x",
    "owner": "ann",
    "state": "queued",
    "attempt": "0",
    "spec": json.dumps(SPEC),
    "mesh": json.dumps({"size_bytes": 3, "sha256": "ab"}),
    "silhouette": json.dumps({"size_bytes": 3, "sha256": "ab"}),
    "created_ms": "1",
    "expires_ms": "2",
}


def test_the_spec_of_a_newer_service_passes_through() -> None:
    job = Job.decode(FIELDS)
    assert job.spec == SPEC
    assert job.timeout_s == 60
    shown = job.refinement()
    assert (shown.state, shown.options.preset, shown.options.seed) == (State.QUEUED, "fast", 3)
