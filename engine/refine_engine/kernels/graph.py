"""One iteration recorded as a CUDA graph and replayed: one launch in the place of several hundred.

An iteration can be recorded if it takes no argument, returns nothing, reads and writes tensors that stay
where they are, and never asks for a value on the host. The counter of a loop is such a tensor too.
"""

from __future__ import annotations

import threading
import warnings
from collections import deque
from collections.abc import Callable
from typing import Protocol

import torch

EAGER_RUNS = 3  # before the recording: kernels are compiled, workspaces and optimiser state made
IN_FLIGHT = 2  # replays queued: the card never waits for Python, a cancellation for two replays at most

_recording = threading.Lock()  # a recording must not meet the synchronisation that starts another one


def repeatable(iteration: Callable[[], None], device: torch.device) -> Callable[[], None]:
    """`iteration`, for many calls: as it is on the CPU, recorded once and replayed on a CUDA device.

    Every call is one iteration, the runs before the recording included. What is queued before a call is seen
    by it, what is queued after it on the caller's stream sees its results, as with any torch operation.
    """
    return Recorded(iteration, device) if device.type == "cuda" else iteration


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


class Recorded:
    """See `repeatable`. Several may run in one process, each in its thread, side by side on the card."""

    def __init__(self, iteration: Callable[[], None], device: torch.device) -> None:
        self._iteration = iteration
        self._device = device
        # one for all runs: autograd remembers on which stream a leaf was used
        self._stream = torch.cuda.Stream(device)
        self._graph: torch.cuda.CUDAGraph | None = None
        self._eager_runs = 0
        self._backlog = Backlog(IN_FLIGHT)

    def __call__(self) -> None:
        with torch.cuda.device(self._device):
            caller = torch.cuda.current_stream()
            self._stream.wait_stream(caller)
            with torch.cuda.stream(self._stream):
                self._run()
                done = torch.cuda.Event(blocking=True)  # sleeps: spinning would take a core from the others
                done.record()
            caller.wait_stream(self._stream)
        self._backlog.add(done)

    def _run(self) -> None:
        if self._eager_runs < EAGER_RUNS:
            self._eager_runs += 1
            with warnings.catch_warnings():  # an optimiser made to be recorded says so when it is not yet
                warnings.filterwarnings("ignore", "This instance was constructed with capturable=True")
                self._iteration()
            return
        if self._graph is None:
            self._graph = self._record()
        self._graph.replay()

    def _record(self) -> torch.cuda.CUDAGraph:
        graph = torch.cuda.CUDAGraph()
        # thread_local: what other threads do on their streams meanwhile is no error of this recording
        with (
            _recording,
            torch.cuda.graph(graph, stream=self._stream, capture_error_mode="thread_local"),
        ):
            self._iteration()
        return graph
