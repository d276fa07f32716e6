"""One iteration recorded as a CUDA graph and replayed: one launch in the place of several hundred.

An iteration can be recorded if it takes no argument, returns nothing, reads and writes tensors that stay
where they are, and never asks for a value on the host. The counter of a loop is such a tensor too.

    with repeatable(step, device) as repeat:
        for _ in range(400):
            repeat()

What torch makes of a stream decides the rules here. It hands out 32 of them in turn, keeps a cuBLAS workspace
for each that was used, and frees this with any graph that was recorded on it. So a thread has one stream on a
device for all its recordings, and one of them at a time.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from typing import Protocol, Self
from weakref import WeakValueDictionary

import torch

EAGER_RUNS = 3  # before the recording: kernels are compiled, workspaces and optimiser state made
IN_FLIGHT = 2  # replays queued: the card never waits for Python, a cancellation for two replays at most
TOLD_AS = ("out of memory", "ALLOC_FAILED")  # of CUDA and its libraries, where torch has no class of its own

_turn = threading.Lock()  # a recording meets no end of a graph, and not what another one starts with
_Place = tuple[int, int]  # thread, device
_streams: dict[_Place, torch.cuda.Stream] = {}
_open: WeakValueDictionary[_Place, Recorded] = WeakValueDictionary()  # whose graph is alive


def repeatable(iteration: Callable[[], None], device: torch.device) -> Repeatable:
    """`iteration`, for many calls: as it is on the CPU, recorded once and replayed on a CUDA device.

    Every call is one iteration, the runs before the recording included. What is queued before a call is seen
    by it, what is queued after it on the caller's stream sees its results, as with any torch operation.
    """
    return Recorded(iteration, device) if device.type == "cuda" else Repeatable(iteration)


class Repeatable:
    """An iteration that is called as it is. Its context ends when no more calls will come."""

    def __init__(self, iteration: Callable[[], None]) -> None:
        self._iteration = iteration

    def __call__(self) -> None:
        self._iteration()

    def close(self) -> None:
        """Wait for the calls that are under way, and free what was made for them."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class Event(Protocol):
    """What Backlog needs of torch.cuda.Event."""

    def synchronize(self) -> None: ...


class Backlog:
    """Holds the caller back while `limit` pieces of work are under way."""

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._pending: deque[Event] = deque()

    def add(self, done: Event) -> None:
        """One more piece, whose end is `done`; waits for the oldest if there are then too many."""
        self._pending.append(done)
        if len(self._pending) > self._limit:
            self._pending.popleft().synchronize()

    def drain(self) -> None:
        """Wait for all of it."""
        while self._pending:
            self._pending.popleft().synchronize()


class Recorded(Repeatable):
    """See `repeatable`. For one thread; up to 32 threads of a process run theirs side by side on the card.

    Every lack of memory, however CUDA tells it, is a torch.OutOfMemoryError. After one during a recording
    torch's allocator cannot go on: end the process, as the worker does.
    """

    def __init__(self, iteration: Callable[[], None], device: torch.device) -> None:
        super().__init__(iteration)
        self._device = device
        self._place = _place(device)
        # the system gives the number of a thread that ended to a new one, and so this gives it the stream
        if self._place not in _streams:
            _streams[self._place] = torch.cuda.Stream(device)
        self._stream = _streams[self._place]
        self._graph: torch.cuda.CUDAGraph | None = None
        self._eager_runs = 0
        self._backlog = Backlog(IN_FLIGHT)

    def __call__(self) -> None:
        with torch.cuda.device(self._device):
            caller = torch.cuda.current_stream()
            self._stream.wait_stream(caller)
            with torch.cuda.stream(self._stream):
                try:
                    self._run()
                except RuntimeError as error:
                    if any(sign in str(error) for sign in TOLD_AS):
                        raise torch.OutOfMemoryError(str(error)) from error
                    raise
                done = torch.cuda.Event(blocking=True)  # sleeps: spinning would take a core from the others
                done.record()
            caller.wait_stream(self._stream)
        self._backlog.add(done)

    def close(self) -> None:
        """Wait for the replays that are under way, then give the graph's memory back."""
        self._backlog.drain()
        if self._graph is not None:
            with _turn:
                self._graph.reset()
            self._graph = None
            del _open[self._place]
        self._eager_runs = 0  # the workspaces went with the graph

    def _run(self) -> None:
        if self._eager_runs < EAGER_RUNS:
            self._eager_runs += 1
            self._iteration()
            return
        if self._graph is None:
            if self._place in _open:
                raise ValueError(
                    "expected one recording at a time in a thread, got a second one; "
                    "leave the `with` block of the first one before"
                )
            with _turn:
                self._graph = self._record()
            _open[self._place] = self
        self._graph.replay()

    def _record(self) -> torch.cuda.CUDAGraph:
        graph = torch.cuda.CUDAGraph()
        failure: Exception | None = None
        try:
            # thread_local: what other threads do on their streams meanwhile is no error of this recording
            with torch.cuda.graph(graph, stream=self._stream, capture_error_mode="thread_local"):
                try:
                    self._iteration()
                except Exception as error:
                    failure = error
        except RuntimeError as error:
            failure = failure or error  # that a broken recording does not end well tells nothing
        if failure is not None:
            raise failure
        return graph


def _place(device: torch.device) -> _Place:
    index = torch.cuda.current_device() if device.index is None else device.index
    return threading.get_ident(), index
