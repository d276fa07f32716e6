"""The recorder, on a card that only writes down what it is asked to do; a real one is in test_card.py."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext

import pytest
import torch

from refine_engine.kernels import graph
from refine_engine.kernels.graph import EAGER_RUNS, IN_FLIGHT, Backlog, repeatable

CARD = torch.device("cuda:0")


class Stream:
    """Of the caller, or one that was made."""

    def __init__(self, device: torch.device | None = None) -> None:
        self.device = device

    def wait_stream(self, other: Stream) -> None:
        pass


class Card:
    """Stands in for torch.cuda. A replay does nothing but appear in the diary."""

    def __init__(self) -> None:
        self.diary: list[str] = []
        self.streams: list[Stream] = []
        self.events = 0
        self.busy = threading.Lock()  # held by what must not meet a recording
        self.broken_end = False
        self.replay_error: Exception | None = None

    def patches(self) -> dict[str, object]:
        """By name in torch.cuda."""
        return {
            "CUDAGraph": lambda: Graph(self),
            "Event": lambda blocking: Event(self),
            "Stream": self.new_stream,
            "current_device": lambda: 0,
            "current_stream": Stream,
            "device": lambda device: nullcontext(),
            "graph": self.recording,
            "stream": lambda stream: nullcontext(),
        }

    def new_stream(self, device: torch.device) -> Stream:
        self.streams.append(Stream(device))
        return self.streams[-1]

    @contextmanager
    def recording(self, recorded: Graph, stream: Stream, capture_error_mode: str) -> Iterator[None]:
        assert self.busy.acquire(blocking=False)
        self.diary.append("record")
        yield
        self.busy.release()
        if self.broken_end:
            raise RuntimeError("operation failed due to a previous error during capture")


class Event:
    def __init__(self, card: Card) -> None:
        card.events += 1
        self.card, self.number = card, card.events

    def record(self) -> None:
        pass

    def synchronize(self) -> None:
        self.card.diary.append(f"waited {self.number}")


class Graph:
    def __init__(self, card: Card) -> None:
        self.card = card

    def replay(self) -> None:
        if self.card.replay_error is not None:
            raise self.card.replay_error
        self.card.diary.append("replay")

    def reset(self) -> None:
        assert self.card.busy.acquire(blocking=False)
        self.card.diary.append("reset")
        self.card.busy.release()


@pytest.fixture
def card(monkeypatch: pytest.MonkeyPatch) -> Card:
    fake = Card()
    for name, stand_in in fake.patches().items():
        monkeypatch.setattr(torch.cuda, name, stand_in)
    monkeypatch.setattr(graph, "_streams", {})
    return fake


def run(iteration: Callable[[], None], calls: int = EAGER_RUNS + 1) -> None:
    with repeatable(iteration, CARD) as repeat:
        for _ in range(calls):
            repeat()


def in_a_thread(work: Callable[[], object]) -> None:
    thread = threading.Thread(target=work)
    thread.start()
    thread.join()


def test_on_the_cpu_an_iteration_is_called_as_it_is() -> None:
    calls: list[int] = []
    with repeatable(lambda: calls.append(1), torch.device("cpu")) as repeat:
        for _ in range(5):
            repeat()
    assert len(calls) == 5


def test_on_a_card_it_is_run_then_recorded_then_replayed(card: Card) -> None:
    repeat = repeatable(lambda: card.diary.append("run"), CARD)
    for _ in range(EAGER_RUNS + IN_FLIGHT):
        repeat()
    did = [entry for entry in card.diary if not entry.startswith("waited")]
    assert did == ["run"] * EAGER_RUNS + ["record", "run"] + ["replay"] * IN_FLIGHT


@pytest.mark.parametrize("failing", [False, True])
def test_the_replays_under_way_end_before_their_graph(card: Card, failing: bool) -> None:
    calls = EAGER_RUNS + 4
    with pytest.raises(KeyError) if failing else nullcontext(), repeatable(lambda: None, CARD) as repeat:
        for _ in range(calls):
            repeat()
        assert f"waited {calls - IN_FLIGHT}" in card.diary
        assert f"waited {calls - 1}" not in card.diary
        if failing:
            raise KeyError
    assert card.diary[-IN_FLIGHT - 1 :] == [f"waited {calls - 1}", f"waited {calls}", "reset"]


def test_after_its_end_it_starts_anew(card: Card) -> None:
    repeat = repeatable(lambda: card.diary.append("run"), CARD)
    for _ in range(EAGER_RUNS + 1):
        repeat()
    repeat.close()
    repeat.close()
    card.diary.clear()
    for _ in range(EAGER_RUNS + 1):
        repeat()
    assert [entry for entry in card.diary if entry in ("run", "record", "reset")] == [
        *["run"] * EAGER_RUNS, "record", "run",
    ]  # fmt: skip


def test_a_thread_has_one_stream_for_all_its_recordings(card: Card) -> None:
    for _ in range(3):
        with repeatable(lambda: None, CARD) as repeat:
            repeat()
    assert len(card.streams) == 1
    in_a_thread(lambda: repeatable(lambda: None, CARD))
    assert len(card.streams) == 2
    repeatable(lambda: None, torch.device("cuda:1"))
    repeatable(lambda: None, torch.device("cuda"))  # the current one, which is 0
    assert len(card.streams) == 3


def test_a_thread_has_one_recording_at_a_time(card: Card) -> None:
    def recorded() -> graph.Repeatable:
        repeat = repeatable(lambda: None, CARD)
        for _ in range(EAGER_RUNS + 1):
            repeat()
        return repeat

    first = recorded()
    with pytest.raises(ValueError, match="one recording at a time"):
        recorded()
    in_a_thread(recorded)
    assert card.diary.count("record") == 2  # that of the other thread too
    first.close()
    second = recorded()
    del second  # forgotten without an end
    recorded().close()


def test_recordings_and_ends_of_graphs_take_turns(card: Card) -> None:
    """`Card` notices when they meet."""
    failures: list[BaseException] = []

    def work() -> None:
        try:
            for _ in range(10):
                run(lambda: time.sleep(0.001))  # others come to their turn
        except BaseException as failure:
            failures.append(failure)

    threads = [threading.Thread(target=work) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert failures == []
    assert card.diary.count("record") == card.diary.count("reset") == 40


@pytest.mark.parametrize("broken_end", [False, True])
@pytest.mark.parametrize("error", [torch.OutOfMemoryError("no memory"), KeyError("a bug")])
def test_what_breaks_a_recording_is_told(card: Card, broken_end: bool, error: Exception) -> None:
    """Not that the recording could not end, which is what comes of it."""

    def iteration() -> None:
        if "record" in card.diary:
            raise error

    card.broken_end = broken_end
    with pytest.raises(type(error)) as told:
        run(iteration)
    assert told.value is error


@pytest.mark.parametrize(
    ("error", "told_as"),
    [
        ("CUDA error: out of memory", torch.OutOfMemoryError),
        (
            "CUDA error: CUBLAS_STATUS_ALLOC_FAILED when calling `cublasCreate(handle)`",
            torch.OutOfMemoryError,
        ),
        ("CUDA error: an illegal memory access was encountered", RuntimeError),
    ],
)
def test_a_lack_of_memory_has_one_class(card: Card, error: str, told_as: type[Exception]) -> None:
    card.replay_error = RuntimeError(error)
    with pytest.raises(RuntimeError, match=error[:20]) as told:
        run(lambda: None)
    assert type(told.value) is told_as


def test_backlog_waits_for_the_oldest_beyond_its_limit() -> None:
    waited: list[int] = []

    class Done:
        def __init__(self, number: int) -> None:
            self.number = number

        def synchronize(self) -> None:
            waited.append(self.number)

    backlog = Backlog(2)
    for number in range(5):
        backlog.add(Done(number))
        assert waited == list(range(number - 1))
    backlog.drain()
    assert waited == list(range(5))
