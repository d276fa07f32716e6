"""How many slots a machine gets: never more threads than cores."""

from __future__ import annotations

import itertools
import os

import pytest

from refine_worker.plan import PlanError, find_cuda_devices, plan_slots
from refine_worker.settings import WorkerSettings

GIB = 2**30


def plan(cores: int, cuda: list[str] | None = None, **settings: object) -> list[tuple[str, str, int]]:
    """Device, CUDA_VISIBLE_DEVICES and threads of every slot."""
    slots = plan_slots(WorkerSettings.model_validate(settings), cores, GIB, cuda or [], "host")
    assert len({slot.name for slot in slots}) == len(slots)
    return [(slot.device, slot.cuda_visible_devices, slot.threads) for slot in slots]


def test_a_cpu_has_a_slot_per_core() -> None:
    assert plan(3) == [("cpu", "", 1)] * 3
    assert plan(8, threads_per_slot=3) == [("cpu", "", 3)] * 2
    assert plan(8, slots_per_device=2) == [("cpu", "", 1)] * 2
    assert plan(8, ["0"], devices="cpu", slots_per_device=1, threads_per_slot=8) == [("cpu", "", 8)]


def test_a_card_has_four_slots() -> None:
    assert plan(16, ["0"]) == [("cuda:0", "0", 4)] * 4
    assert plan(16, ["2", "GPU-5"]) == [("cuda:0", "2", 2)] * 4 + [("cuda:1", "GPU-5", 2)] * 4
    assert plan(16, ["2", "3"], devices="cuda:1") == [("cuda:1", "3", 4)] * 4
    assert plan(2, ["0"]) == [("cuda:0", "0", 1)] * 2


def test_slots_that_share_a_card_tell_torch_so() -> None:
    (slot, *_) = plan_slots(WorkerSettings(), 16, GIB, ["0"], "host")
    environment = slot.engine_environment()
    assert environment["CUDA_VISIBLE_DEVICES"] == "0"
    assert environment["PYTORCH_ALLOC_CONF"] == "expandable_segments:True"


@pytest.mark.parametrize("cuda", [[], ["0"], ["0", "1"]])
def test_defaults_never_exceed_the_cores(cuda: list[str]) -> None:
    for cores, threads in itertools.product(range(4, 20), (None, 1, 2)):
        assert sum(slot[2] for slot in plan(cores, cuda, threads_per_slot=threads)) <= cores


@pytest.mark.parametrize(
    "settings",
    [
        {"slots_per_device": 5},
        {"threads_per_slot": 5},
        {"slots_per_device": 2, "threads_per_slot": 3},
        {"devices": "cuda", "slots_per_device": 5},
    ],
)
def test_more_threads_than_cores_are_refused(settings: dict[str, object]) -> None:
    with pytest.raises(PlanError, match="slots x threads of at most 4"):
        plan(4, ["0"] if "devices" in settings else [], **settings)


@pytest.mark.parametrize("devices", ["cuda", "cuda:1", "cpu,cuda:0", "cuda:0,cuda:0", "gpu"])
def test_devices_that_are_not_there_are_refused(devices: str) -> None:
    found = ["0"] if devices != "cuda" else []
    with pytest.raises(PlanError, match="REFINE_DEVICES"):
        plan(4, found, devices=devices)


def test_this_machine_needs_no_cuda() -> None:
    assert find_cuda_devices(os.environ | {"CUDA_VISIBLE_DEVICES": ""}) == []


def test_an_engine_gets_its_threads_and_its_device_only() -> None:
    [slot] = plan_slots(WorkerSettings(slots_per_device=1, threads_per_slot=3), 4, GIB, ["7"], "host")
    environment = slot.engine_environment()
    assert environment["CUDA_VISIBLE_DEVICES"] == "7"
    threads = {name: value for name, value in environment.items() if name.endswith("NUM_THREADS")}
    assert set(threads) >= {"OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"}
    assert set(threads.values()) == {"3"}


@pytest.mark.parametrize(
    ("memory", "cores", "read"), [(16 * GIB, 8, GIB), (512 * GIB, 8, 4 * GIB), (2 * GIB, 1, GIB)]
)
def test_reading_may_take_half_of_what_there_is_for_a_slot(memory: int, cores: int, read: int) -> None:
    slots = plan_slots(WorkerSettings(), cores, memory, [], "host")
    assert [slot.read_limits.memory_bytes for slot in slots] == [read] * cores
    [slot] = plan_slots(WorkerSettings(read_memory_bytes=7), 1, memory, [], "host")
    assert slot.read_limits.memory_bytes == 7


def test_large_files_may_take_longer() -> None:
    [slot] = plan_slots(WorkerSettings(read_cpu_s=5, read_timeout_s=20), 1, GIB, [], "host")
    assert (slot.read_limits.cpu_s(0), slot.read_limits.wall_s(0)) == (5, 20)
    assert (slot.read_limits.cpu_s(20_000_000), slot.read_limits.wall_s(20_000_000)) == (15, 40)
