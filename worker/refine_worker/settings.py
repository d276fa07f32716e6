"""REFINE_* settings of the worker. Built once in each process's `main` and passed down."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field

from refine_jobs.settings import EnvironmentSettings

_READ_BYTES_PER_S = 2_000_000  # the slowest reader takes more than twice as many


class ReadLimits(BaseModel):
    """What reading the files of a job may cost its slot."""

    model_config = ConfigDict(frozen=True)

    base_cpu_s: float
    base_wall_s: float
    memory_bytes: int

    def cpu_s(self, size_bytes: int) -> float:
        """CPU seconds for files of so many bytes."""
        return self.base_cpu_s + size_bytes / _READ_BYTES_PER_S

    def wall_s(self, size_bytes: int) -> float:
        """Seconds that pass meanwhile, at most: for what waits, and for a machine that does other things."""
        return self.base_wall_s + 2 * size_bytes / _READ_BYTES_PER_S


class WorkerSettings(EnvironmentSettings):
    """How many slots there are, and how patient they are."""

    devices: str = Field(
        "auto", description="auto, cpu, cuda (all) or cuda:0,cuda:1; auto: all CUDA devices, else cpu."
    )
    slots_per_device: int | None = Field(
        None, ge=1, description="Jobs at a time on one device; unset: 4 on CUDA, else cores / threads."
    )
    threads_per_slot: int | None = Field(
        None, ge=1, description="CPU threads of one job; unset: 1 on the CPU, cores / slots on CUDA."
    )
    worker_host: str = Field("127.0.0.1", description="Address of worker_port; 0.0.0.0 for all.")
    worker_port: int | None = Field(
        None, ge=0, le=65535, description="Probes and metrics of the worker over HTTP; unset: none."
    )
    slot_timeout_s: float = Field(
        30, gt=0, description="A slot that does not report for so long is killed and started again."
    )
    jobs_per_engine: int = Field(200, ge=1, description="An engine process is replaced after so many jobs.")
    start_timeout_s: float = Field(300, gt=0, description="For loading and warming up an engine process.")
    read_cpu_s: float = Field(
        8, gt=0, description="CPU seconds for reading the files of a job; each 2 MB of them adds one."
    )
    read_timeout_s: float = Field(
        30, gt=0, description="Seconds that may pass meanwhile; each 2 MB of them adds two."
    )
    read_memory_bytes: int | None = Field(
        None, gt=0, description="What reading them may allocate (Linux); unset: half of a slot's share."
    )
    checkpoint_s: float = Field(
        10, gt=0, description="Between two checkpoints of a running job, from which another slot goes on."
    )
    stall_timeout_s: float = Field(600, gt=0, description="Without any progress for so long, a job has hung.")
    cancel_grace_s: float = Field(
        1.2, ge=0, description="From asking an engine process to stop to killing it."
    )
    stop_grace_s: float = Field(
        25, ge=0, description="From SIGTERM to giving a running job back; keep it below the container's."
    )
