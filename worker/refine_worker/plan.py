"""Which slots this machine gets: devices, slots per device, threads per slot.

Slots x threads never exceeds the cores that the process may use: OpenMP threads spin while they wait, and two
on a busy core were measured four times slower than one.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from pydantic import BaseModel, ConfigDict

from .settings import ReadLimits, WorkerSettings

SLOTS_PER_CUDA_DEVICE = 4
NEVER_READY = 3  # exit code of a slot process whose engine process could not start, before its first job
_MOST_READ_MEMORY_BYTES = 4 * 2**30  # no file that is let in by default needs half of it
_CUDA_DRIVERS = ("/dev/nvidiactl", "/dev/dxg")  # Linux, and Linux below Windows
_PROBE = "import torch; print(torch.cuda.device_count())"
_PROBE_TIMEOUT_S = 120


class PlanError(Exception):
    """The settings cannot be met on this machine; the message says what to change."""


class SlotPlan(BaseModel):
    """One slot, as it is told to the slot process on its command line."""

    model_config = ConfigDict(frozen=True)

    name: str
    device: str  # cpu, or cuda:N
    threads: int
    read_limits: ReadLimits
    cuda_visible_devices: str = ""  # of the engine process; it sees one device at most

    def engine_environment(self) -> dict[str, str]:
        """What must be set before the engine process starts, because libraries read it when they load."""
        threads = str(self.threads)
        return {
            "CUDA_VISIBLE_DEVICES": self.cuda_visible_devices,
            "MKL_NUM_THREADS": threads,
            "NUMBA_NUM_THREADS": threads,
            "OMP_NUM_THREADS": threads,
            "OPENBLAS_NUM_THREADS": threads,
            "PYTORCH_ALLOC_CONF": "expandable_segments:True",  # several slots share the card
            "TOKIO_WORKER_THREADS": "1",  # the blob store's I/O threads
            "VECLIB_MAXIMUM_THREADS": threads,
        }


def plan_slots(
    settings: WorkerSettings, cores: int, memory_bytes: int, cuda_devices: Sequence[str], prefix: str
) -> tuple[SlotPlan, ...]:
    """The slots for `cores`, `memory_bytes` and the CUDA devices that were found.

    These are given as their CUDA_VISIBLE_DEVICES names. Slot names start with `prefix`. Raises PlanError.
    """
    devices = _choose(settings.devices, cuda_devices)
    on_cpu = devices == ["cpu"]
    if settings.slots_per_device is not None:
        per_device = settings.slots_per_device
    elif on_cpu:
        per_device = max(1, cores // (settings.threads_per_slot or 1))
    else:
        share = cores // len(devices) // (settings.threads_per_slot or 1)
        per_device = min(SLOTS_PER_CUDA_DEVICE, max(1, share))
    slots = per_device * len(devices)
    threads = settings.threads_per_slot or (1 if on_cpu else max(1, cores // slots))
    if slots * threads > cores:
        raise PlanError(
            f"expected slots x threads of at most {cores}, the cores that this process may use, got "
            f"{slots} x {threads} ({per_device} slots on each of {', '.join(devices)}); lower "
            "REFINE_SLOTS_PER_DEVICE or REFINE_THREADS_PER_SLOT, or name fewer REFINE_DEVICES"
        )
    read_limits = ReadLimits(
        base_cpu_s=settings.read_cpu_s,
        base_wall_s=settings.read_timeout_s,
        memory_bytes=settings.read_memory_bytes or min(_MOST_READ_MEMORY_BYTES, memory_bytes // (2 * slots)),
    )
    return tuple(
        SlotPlan(
            name=f"{prefix}-{number}",
            device=device,
            threads=threads,
            read_limits=read_limits,
            cuda_visible_devices="" if on_cpu else cuda_devices[int(device.removeprefix("cuda:"))],
        )
        for number, device in enumerate(d for d in devices for _ in range(per_device))
    )


def _choose(wanted: str, cuda_devices: Sequence[str]) -> list[str]:
    found = [f"cuda:{index}" for index in range(len(cuda_devices))]
    names = [name.strip() for name in wanted.split(",")]
    if names == ["auto"]:
        return found or ["cpu"]
    if names == ["cpu"]:
        return names
    if names == ["cuda"] and found:
        return found
    if len(set(names)) < len(names) or not set(names) <= set(found):
        raise PlanError(
            f"expected REFINE_DEVICES to be auto, cpu, cuda or some of the CUDA devices found "
            f"({', '.join(found) or 'none'}), got {wanted!r}"
        )
    return names


def find_cuda_devices(environment: Mapping[str, str] = os.environ) -> list[str]:
    """CUDA_VISIBLE_DEVICES names of the devices that torch can use.

    A throw-away process asks torch: only it knows whether build, driver and device go together, and this
    process neither imports it nor initialises CUDA.
    """
    if not any(Path(driver).exists() for driver in _CUDA_DRIVERS):
        return []
    try:
        probe = subprocess.run(
            [sys.executable, "-c", _PROBE],
            env=dict(environment),
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            timeout=_PROBE_TIMEOUT_S,
        )
        count = int(probe.stdout)
    except (subprocess.TimeoutExpired, ValueError):
        return []
    visible = environment.get("CUDA_VISIBLE_DEVICES")
    names = visible.split(",") if visible else [str(index) for index in range(count)]
    return [name.strip() for name in names[:count]]
