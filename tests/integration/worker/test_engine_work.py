"""What the engine process does with one job, in this process: the messages, and what it leaves behind."""

from __future__ import annotations

import gc
import io
import json
import math
import threading
from collections.abc import Iterator
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from pydantic import ValidationError

from refine_engine.errors import SilhouetteInvalid
from refine_engine.values import Progress
from refine_jobs import keys
from refine_jobs.blobs import BlobStore
from refine_jobs.record import Task
from refine_proto import models
from refine_worker import messages
from refine_worker.engine.main import work
from refine_worker.engine.refinery import Refinery, Reporter
from refine_worker.messages import Answered, Failed, FromEngine, Progressed, Ready, Run
from refine_worker.settings import ReadLimits

SAMPLE = Path(__file__).parents[3] / "examples" / "samples" / "table"
LIMITS = ReadLimits(base_cpu_s=60, base_wall_s=60, memory_bytes=2**32)
DEVICES = [
    pytest.param("cpu"),
    pytest.param("cuda", marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")),
]


@pytest.fixture
def blobs(tmp_path: Path) -> BlobStore:
    """With the files of `job`, and of `bad`, whose mesh is none."""
    blobs = BlobStore(str(tmp_path))
    for job, mesh in (("job", (SAMPLE / "coarse.obj").read_bytes()), ("bad", b"v 0 0 0\n")):
        blobs.put(keys.input_blob(job, keys.MESH), mesh)
        blobs.put(keys.input_blob(job, keys.SILHOUETTE), (SAMPLE / "silhouette.png").read_bytes())
    return blobs


@pytest.fixture
def pipe() -> Iterator[tuple[Connection, Connection]]:
    ours, theirs = Pipe()
    with ours, theirs:
        yield ours, theirs


def run(job_id: str, **options: object) -> Run:
    camera = json.loads((SAMPLE / "camera.json").read_text())
    spec = {"camera": camera, "mesh_format": "obj", "options": {"iterations": 2, **options}}
    return Run(job_id=job_id, attempt=1, spec=spec)


def test_a_camera_is_estimated(blobs: BlobStore, pipe: tuple[Connection, Connection]) -> None:
    ours, theirs = pipe
    spec = {"camera": {"type": "estimate"}, "mesh_format": "obj"}
    asked = Run(job_id="job", attempt=1, task=Task.ESTIMATE, spec=spec)
    work(Refinery(blobs, torch.device("cpu"), LIMITS, 10), asked, theirs, threading.Event())
    answered = told(ours)[-1]
    assert isinstance(answered, Answered)
    assert isinstance(answered.answer, models.CameraEstimate)
    assert answered.answer.silhouette_iou > 0.5


def told(connection: Connection) -> list[FromEngine]:
    """All messages that are there."""
    found = []
    while connection.poll():
        found.append(messages.receive_in_slot(connection))
    return found


def held(device: str) -> tuple[int, int]:
    """Tensors that are alive, and what others cannot have of the card, in steps larger than workspaces."""
    alive = sum(issubclass(type(thing), torch.Tensor) for thing in gc.get_objects())
    return alive, torch.cuda.memory_reserved() // 2**27 if device == "cuda" else 0


@pytest.fixture
def nobody_tidies() -> Iterator[None]:
    """Cycles stay until somebody asks for a collection."""
    gc.disable()
    yield
    gc.enable()


@pytest.mark.usefixtures("nobody_tidies")
@pytest.mark.parametrize("device", DEVICES)
def test_nothing_of_a_job_stays_however_it_ends(
    device: str, blobs: BlobStore, pipe: tuple[Connection, Connection]
) -> None:
    refinery = Refinery(blobs, torch.device(device), LIMITS, 10)
    go_on, stop = threading.Event(), threading.Event()
    stop.set()
    ends = [
        (run("job"), go_on, "done"),
        (run("job", preset="paper"), go_on, "done"),
        (run("job", preset="paper"), stop, "CANCELLED"),
        (run("bad"), go_on, "MESH_INVALID"),
        (run("missing"), go_on, "INTERNAL"),
    ]
    left = []
    for _ in range(2):  # what is kept for good is there after the first round
        for job, cancelled, expected in ends:
            work(refinery, job, pipe[1], cancelled)
            end = told(pipe[0])[-1]
            assert (end.reason if isinstance(end, Failed) else end.type) == expected
            left.append(held(device))
    assert left[len(ends) :] == [left[len(ends) - 1]] * len(ends)


def test_a_progress_without_numbers_reaches_the_slot(pipe: tuple[Connection, Connection]) -> None:
    """0 / 0 is no number, and JSON has no word for it."""
    report = Reporter(lambda message: messages.send(pipe[1], message))
    report(Progress(1, 2, {"total": 3.0, "silhouette": math.nan}, math.nan))
    [message] = told(pipe[0])
    assert isinstance(message, Progressed)
    assert (message.progress.losses, message.progress.silhouette_iou) == ({"total": 3.0}, 0.0)


@pytest.mark.parametrize("number", [math.nan, math.inf])
def test_no_message_carries_what_is_no_number(number: float) -> None:
    with pytest.raises(ValidationError, match="finite"):
        models.Progress(iteration=1, total=2, percent=50, silhouette_iou=number)
    with pytest.raises(ValidationError, match="finite"):
        Ready(seconds=number)


def test_all_views_and_what_is_unknown_reach_the_engine(
    blobs: BlobStore, pipe: tuple[Connection, Connection]
) -> None:
    """A second silhouette of another size is read, and its ignore mask is for it alone."""
    image = io.BytesIO()
    Image.new("L", (64, 64)).save(image, "PNG")
    silhouette = (SAMPLE / "silhouette.png").read_bytes()
    camera = json.loads((SAMPLE / "camera.json").read_text())
    for name, data in {"silhouette_2": silhouette, "ignore_2": image.getvalue()}.items():
        blobs.put(keys.input_blob("job", name), data)
    told_run = run("job")
    spec = {**told_run.spec, "views": [{"camera": camera}]}
    more = told_run.model_copy(update={"spec": spec, "more_files": ("silhouette_2", "ignore_2")})
    with pytest.raises(
        SilhouetteInvalid, match="view 2: expected an ignore mask of the silhouette's size 224x224"
    ):
        Refinery(blobs, torch.device("cpu"), LIMITS, 10).refine(more, lambda _: None, lambda: False)
    blobs.put(keys.input_blob("job", "ignore_2"), _half_known())
    done = Refinery(blobs, torch.device("cpu"), LIMITS, 10).refine(more, lambda _: None, lambda: False)
    assert {artifact.name for artifact in done.artifacts} >= {"refined.glb", "report.json"}


def _half_known() -> bytes:
    pixels = np.zeros((224, 224), np.uint8)
    pixels[:112] = 255
    image = io.BytesIO()
    Image.fromarray(pixels).save(image, "PNG")
    return image.getvalue()


def test_a_job_can_ask_for_smaller_triangles(blobs: BlobStore) -> None:
    cube = "".join(f"v {x} {y} {z}\n" for x in (-0.4, 0.4) for y in (-0.3, 0.3) for z in (-0.4, 0.4))
    cube += "f 1 2 4 3\nf 5 7 8 6\nf 1 5 6 2\nf 3 4 8 7\nf 1 3 7 5\nf 2 6 8 4\n"
    blobs.put(keys.input_blob("cube", keys.MESH), cube.encode())
    blobs.put(keys.input_blob("cube", keys.SILHOUETTE), (SAMPLE / "silhouette.png").read_bytes())
    refinery = Refinery(blobs, torch.device("cpu"), LIMITS, 10)
    for subdivide in (False, True):
        done = refinery.refine(run("cube", subdivide=subdivide), lambda message: None, lambda: False)
        counts = done.judgement.mesh_counts
        assert counts is not None
        assert (counts.vertices, counts.refined_vertices > 500) == (8, subdivide)
