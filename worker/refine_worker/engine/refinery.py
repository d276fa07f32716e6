"""The engine's work on one job: read, configure, refine, make the artifacts."""

from __future__ import annotations

import gc
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager

import torch

from refine_engine.artifacts.make import make_artifacts
from refine_engine.cameras.seen import mean_silhouette_iou
from refine_engine.checks.check import GivenPlane, refuse
from refine_engine.contract import config_of, estimate_of, judgement_of
from refine_engine.method.config import RefineConfig
from refine_engine.request import Inputs, Observation, check_files
from refine_engine.values import Progress
from refine_jobs import keys
from refine_jobs.blobs import BlobStore, BlobStoreFailed
from refine_proto.formats import ARTIFACTS, IGNORE, MESH, SILHOUETTE, of_view
from refine_proto.models import Artifact, RefinementSpec, Validation
from refine_proto.progress import ProgressMeter

from ..messages import Answered, Done, FromEngine, Phase, PhaseStarted, Progressed, Run
from ..settings import ReadLimits
from .checkpoints import checkpoints_of
from .limits import parsing

Tell = Callable[[FromEngine], None]


class MemoryShort(Exception):
    """Memory of the machine or of the device did not suffice; the message says for what."""


class Refinery:
    """Turns the files of a job into its artifacts, on one device."""

    def __init__(
        self, blobs: BlobStore, device: torch.device, limits: ReadLimits, checkpoint_s: float
    ) -> None:
        self._blobs, self._device = blobs, device
        self._limits, self._checkpoint_s = limits, checkpoint_s

    def refine(self, run: Run, tell: Tell, cancelled: Callable[[], bool]) -> Done:
        """Do the job. Raises the engine's errors and MemoryShort."""
        spec = RefinementSpec.model_validate(run.spec)
        config = config_of(spec.options)
        inputs = self._read(run, spec, config, tell)
        refuse(inputs.findings)
        tell(PhaseStarted(phase=Phase.REFINE))
        with (
            _explained(f"refining {len(inputs.mesh_file.mesh.vertices)} vertices on {self._device.type}"),
            checkpoints_of(self._blobs, run.job_id, self._device, self._checkpoint_s) as checkpoints,
        ):
            result = inputs.refine(config, self._device, Reporter(tell), cancelled, checkpoints)
            tell(PhaseStarted(phase=Phase.STORE))
            artifacts = self._store(run, make_artifacts(inputs, result, config))
        return Done(
            artifacts=artifacts,
            judgement=judgement_of(inputs.mesh_file, result, inputs.estimate),
            checks=inputs.findings,
        )

    def validate(self, run: Run, tell: Tell) -> Answered:
        """Say what `refine` would find in the inputs. Raises the engine's errors and MemoryShort."""
        spec = RefinementSpec.model_validate(run.spec)
        inputs = self._read(run, spec, config_of(spec.options), tell)
        iou = mean_silhouette_iou(inputs.mesh_file.mesh, inputs.views)
        return Answered(answer=Validation.of(iou, inputs.warnings, inputs.findings))

    def estimate(self, run: Run, tell: Tell) -> Answered:
        """Say where the camera may be; the edge has seen that it is to be estimated. The same errors."""
        spec = RefinementSpec.model_validate(run.spec)
        inputs = self._read(run, spec, config_of(spec.options), tell)
        return Answered(answer=estimate_of(inputs.estimate))

    def clear(self) -> None:
        """Give back what a job that has ended, in whatever way, held on the device: other slots want it.

        Not from within `refine`: an error on its way out still holds the tensors of all that it passed.
        """
        gc.collect()  # a run refers to itself
        if self._device.type == "cuda":
            torch.cuda.empty_cache()

    def _read(self, run: Run, spec: RefinementSpec, config: RefineConfig, tell: Tell) -> Inputs:
        tell(PhaseStarted(phase=Phase.FETCH))
        files = {
            part: self._blobs.get(keys.input_blob(run.job_id, part))
            for part in (MESH, SILHOUETTE, *run.more_files)
        }
        tell(PhaseStarted(phase=Phase.READ))
        name = f"mesh.{spec.mesh_format}" if spec.mesh_format else "mesh"
        cpu_s = self._limits.cpu_s(sum(map(len, files.values())))
        with _explained("reading the mesh and the silhouette"), parsing(cpu_s, self._limits.memory_bytes):
            return check_files(
                files[MESH],
                name,
                files[SILHOUETTE],
                spec.camera,
                spec.options.silhouette_threshold,
                ignore_grey=spec.options.ignore_grey,
                ignore=files.get(IGNORE),
                more_views=[
                    Observation(files[of_view(SILHOUETTE, n)], view.camera, files.get(of_view(IGNORE, n)))
                    for n, view in enumerate(spec.views, 2)
                ],
                checks=spec.options.checks,
                symmetry=GivenPlane.of(config),
                subdivide=spec.options.subdivide,
            )

    def _store(self, run: Run, artifacts: Mapping[str, bytes]) -> tuple[Artifact, ...]:
        try:
            stored = {
                name: self._blobs.put(keys.artifact_blob(run.job_id, run.attempt, name), data)
                for name, data in artifacts.items()
            }
        except BlobStoreFailed:
            self._blobs.delete_folder(keys.artifact_folder(run.job_id, run.attempt))  # others need the room
            raise
        return tuple(
            Artifact(
                name=name,
                media_type=media_type,
                size_bytes=stored[name].size_bytes,
                sha256=stored[name].sha256,
            )
            for name, media_type in ARTIFACTS.items()
        )


class Reporter:
    """Tells the slot of the engine's progress, in the words of the contract."""

    def __init__(self, tell: Tell) -> None:
        self._tell, self._meter = tell, ProgressMeter()

    def __call__(self, progress: Progress) -> None:
        told = self._meter.read(progress.iteration, progress.total, progress.losses, progress.silhouette_iou)
        self._tell(Progressed(progress=told))


@contextmanager
def _explained(doing: str) -> Iterator[None]:
    """Tell every kind of lack of memory as MemoryShort."""
    try:
        yield
    except (MemoryError, torch.OutOfMemoryError) as error:
        raise MemoryShort(_too_little_memory(doing)) from error
    except RuntimeError as error:
        if "allocate memory" not in str(error):  # torch's allocator for the CPU has no class of its own
            raise
        raise MemoryShort(_too_little_memory(doing)) from error


def _too_little_memory(doing: str) -> str:
    return f"{doing} needs more memory than there is; use a mesh with fewer vertices"
