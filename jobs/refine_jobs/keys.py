"""Everything in Redis and in the blob store: every key, name and fixed lifetime, on this page.

Lifetimes that an operator may choose are in settings.py. RQ has its own keys under `rq:`; nothing here
touches them. All times are milliseconds of the Redis server, so that one clock rules.
"""

from __future__ import annotations

from refine_proto.formats import MESH as MESH  # "X as X": callers name the blobs of a job by them
from refine_proto.formats import SILHOUETTE as SILHOUETTE

JOB = "refine:job:"  # + id: hash, the record (record.py)
EVENTS = "refine:events:"  # + id: stream of state, progress and completed events; entry ids are <sequence>-0
OWNER = "refine:owner:"  # + owner: sorted set of ids by submission number, for lists
IDEMPOTENCY = "refine:idempotency:"  # + owner + ":" + sha256 of the key: "<id> <fingerprint>"
SUBMISSIONS = "refine:submissions"  # counter: the submission number
QUEUED = "refine:queued"  # sorted set of queued ids by tag (lua/README.md): queue position, global bound
QUEUED_SINCE = "refine:queued-since"  # sorted set of queued ids by the time they entered the queue: its delay
QUEUED_COST = "refine:queued-cost"  # sum of cost_ms of QUEUED
FLOW = "refine:flow:"  # + flow (share.py): sorted set of its queued ids by submission number
FLOWS = "refine:flows"  # sorted set of flows by where the next job of each may start
VIRTUAL_TIME = "refine:virtual-time"  # the tag that has begun, milliseconds of estimated work
PACE = "refine:pace"  # milliseconds of a run for one that was estimated; a mean that follows
QUEUED_BY_OWNER = "refine:queued-by-owner"  # hash owner -> queued jobs; changes together with QUEUED
LEASES = "refine:leases"  # sorted set of running ids by the end of their lease
EXPIRY = "refine:expiry"  # sorted set of ended ids by the time their data goes
UPLOADS = "refine:uploads"  # sorted set of ids whose blobs are being written, by start
TRASH = "refine:trash"  # set of ids whose blobs are to be deleted
MISSING = "refine:missing"  # hash queued id -> when it was first not found in RQ
OUTBOX = "refine:outbox"  # sorted set of ids of webhooks to deliver by the time of their next attempt
WEBHOOK = "refine:webhook:"  # + id: hash, a webhook in OUTBOX (webhook_outbox.py)
SWEPT = "refine:swept"  # there for SWEEP_S after somebody has looked for blobs without a job
METRICS = "refine:metrics"  # hash of counters and histograms written by lua/common.lua
SLOT = "refine:slot:"  # + name: hash, what a worker slot is doing; expires SLOT_S after its last sign of life
SLOTS = "refine:slots"  # sorted set of slot names by expiry
PROBE = "refine:probe"  # written to see whether Redis takes writes
DOORBELL = "refine:doorbell"  # channel: the id of a job that has a new event

EVENTS_KEPT = 1024  # per job; more than a job at two events a second for the default of iterations
SLOT_S = 15  # a slot shows up every few seconds
UPLOAD_S = 3_600  # an upload that has not become a job by then is removed
SWEEP_S = 3_600  # between two looks for blobs without a job
LAST_WORDS_S = 60  # the events of a removed job; somebody may be watching
MISSING_S = 30  # RQ holds no id for this long between taking a job and starting it
RQ_TIMEOUT_MARGIN_S = 120  # RQ's own timeout is the outermost guard, after ours
RQ_RESULT_S = 60  # RQ's view of a finished job; the truth is ours
RQ_FAILURE_S = 86_400  # RQ's default is a year of tracebacks
BUCKETS_S = "0.05 0.1 0.25 0.5 1 2.5 5 10 30 60 120 300 600 1800 3600"  # bounds of the histograms


def lua_constants() -> str:
    """What the scripts use of the above, as Lua locals of the same names."""
    values: dict[str, str | int] = {
        "JOB": JOB,
        "EVENTS": EVENTS,
        "OWNER": OWNER,
        "SUBMISSIONS": SUBMISSIONS,
        "QUEUED": QUEUED,
        "QUEUED_SINCE": QUEUED_SINCE,
        "QUEUED_COST": QUEUED_COST,
        "FLOW": FLOW,
        "FLOWS": FLOWS,
        "VIRTUAL_TIME": VIRTUAL_TIME,
        "PACE": PACE,
        "QUEUED_BY_OWNER": QUEUED_BY_OWNER,
        "LEASES": LEASES,
        "EXPIRY": EXPIRY,
        "UPLOADS": UPLOADS,
        "TRASH": TRASH,
        "MISSING": MISSING,
        "OUTBOX": OUTBOX,
        "WEBHOOK": WEBHOOK,
        "METRICS": METRICS,
        "DOORBELL": DOORBELL,
        "EVENTS_KEPT": EVENTS_KEPT,
        "LAST_WORDS_S": LAST_WORDS_S,
        "MISSING_S": MISSING_S,
        "BUCKETS_S": BUCKETS_S,
    }
    return "".join(f"local {name} = {value!r}\n" for name, value in values.items())


def queue(pool: str) -> str:
    """Name of the pool's one RQ queue. One, because RQ keeps a copy of a taken job only then (BLMOVE)."""
    return f"refine-{pool}"


def idempotency(owner: str, key_sha256: str) -> str:
    """Key of a remembered idempotency key."""
    return f"{IDEMPOTENCY}{owner}:{key_sha256}"


BLOBS = "jobs"  # folder of all blobs


def blob_folder(job_id: str) -> str:
    """Folder of all blobs of a job."""
    return f"{BLOBS}/{job_id}"


def input_blob(job_id: str, part: str) -> str:
    """Name of an uploaded file; `part` is what the request calls it: mesh, silhouette, silhouette_2, ..."""
    return f"jobs/{job_id}/input/{part}"


def checkpoint_folder(job_id: str) -> str:
    """Folder of what another slot can go on from."""
    return f"{BLOBS}/{job_id}/checkpoint"


def checkpoint_blob(job_id: str) -> str:
    """Name of the latest state of a running job."""
    return f"{checkpoint_folder(job_id)}/latest"


def artifact_folder(job_id: str, attempt: int) -> str:
    """Folder of what one attempt has made."""
    return f"jobs/{job_id}/artifacts/{attempt}"


def artifact_blob(job_id: str, attempt: int, name: str) -> str:
    """Name of an artifact; one folder per attempt, so that a lost worker cannot overwrite its successor's."""
    return f"{artifact_folder(job_id, attempt)}/{name}"
