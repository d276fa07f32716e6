"""The engine process of a slot. The only module here that loads torch.

It loads the engine, runs tiny refinements so that every kernel is compiled, says Ready, and then refines
what the slot sends it. A thread reads the pipe: it sees a Cancel while the main thread computes, and the end
of the slot, with which this process ends at once.
"""

from __future__ import annotations

import argparse
import faulthandler
import gc
import logging
import os
import queue
import threading
import time
from collections.abc import Sequence
from multiprocessing.connection import Connection

import torch

from refine_engine.errors import RefineError
from refine_engine.kernels.cuda import keep_float32
from refine_jobs.blobs import BlobStore, BlobStoreFailed
from refine_jobs.logs import configure_logs, log_fields
from refine_jobs.record import Task

from .. import messages
from ..messages import Answered, Cancel, Done, Failed, FromEngine, Ready, Returned, Run
from ..settings import ReadLimits
from .refinery import MemoryShort, Refinery
from .warm_up import presets_to_warm, warm_up

log = logging.getLogger("refine_worker.engine")


def main(argv: Sequence[str]) -> None:
    """Serve one slot until it closes the pipe."""
    started = time.monotonic()
    options = _parse(argv)
    configure_logs(slot=options.slot)
    faulthandler.enable(options.crash_report)
    torch.set_num_threads(options.threads)
    torch.set_num_interop_threads(1)
    keep_float32()
    connection = Connection(options.pipe)
    inbox = Inbox(connection)
    device = torch.device("cuda" if os.environ.get("CUDA_VISIBLE_DEVICES") else "cpu")
    refinery = Refinery(
        BlobStore(options.blobs), device, ReadLimits.model_validate_json(options.limits), options.checkpoint_s
    )
    for preset in presets_to_warm(device):
        warm_up(device, preset)
    gc.collect()
    gc.freeze()  # what is loaded stays; the collection after each job looks at the job's objects only
    gpu_uuid = str(torch.cuda.get_device_properties(device).uuid) if device.type == "cuda" else None
    messages.send(connection, Ready(seconds=time.monotonic() - started, gpu_uuid=gpu_uuid))
    while True:
        run = inbox.next_run()
        with log_fields(run.log_fields):
            work(refinery, run, connection, inbox.cancelled)


def _parse(argv: Sequence[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="The engine process of a worker slot; slots start it.")
    parser.add_argument("slot_pid", type=int, help="the process with which this one ends")
    parser.add_argument("pipe", type=int, help="file descriptor of the pipe to the slot")
    parser.add_argument("crash_report", type=int, help="file descriptor for the stacks of a fatal error")
    parser.add_argument("slot")
    parser.add_argument("threads", type=int)
    parser.add_argument("blobs", help="location of the blob store")
    parser.add_argument("limits", help="ReadLimits, as JSON")
    parser.add_argument("checkpoint_s", type=float)
    return parser.parse_args(argv)


class Inbox:
    """What the slot sends, read by a thread of its own."""

    def __init__(self, connection: Connection) -> None:
        self._runs: queue.SimpleQueue[Run] = queue.SimpleQueue()
        self._connection = connection
        self.cancelled = threading.Event()
        threading.Thread(target=self._read, name="inbox", daemon=True).start()

    def next_run(self) -> Run:
        """Wait for the next job."""
        return self._runs.get()

    def _read(self) -> None:
        while True:
            try:
                message = messages.receive_in_engine(self._connection)
            except (EOFError, OSError):
                os._exit(0)  # the slot is gone, and with it whoever wanted a result
            if isinstance(message, Cancel):
                self.cancelled.set()
            else:
                self.cancelled.clear()
                self._runs.put(message)


def work(refinery: Refinery, run: Run, connection: Connection, cancelled: threading.Event) -> None:
    """Do one job and say how it ended; nothing of it stays in memory."""
    messages.send(connection, _attempt(refinery, run, connection, cancelled))
    refinery.clear()


def _attempt(
    refinery: Refinery, run: Run, connection: Connection, cancelled: threading.Event
) -> Done | Answered | Failed | Returned:
    """Do the task; every way in which that can fail becomes a message."""

    def tell(message: FromEngine) -> None:
        messages.send(connection, message)

    try:
        if run.task is Task.VALIDATE:
            return refinery.validate(run, tell)
        if run.task is Task.ESTIMATE:
            return refinery.estimate(run, tell)
        return refinery.refine(run, tell, cancelled.is_set)
    except RefineError as error:
        return Failed(reason=error.reason, detail=str(error))
    except BlobStoreFailed as error:
        return Returned(why=str(error))
    except MemoryShort as error:
        return Failed(reason="OUT_OF_MEMORY", detail=str(error), replace_engine=True)
    except Exception as error:
        log.exception("the engine failed")
        detail = (
            f"the engine failed unexpectedly ({type(error).__name__}); please report it with the request id"
        )
        return Failed(reason="INTERNAL", detail=detail, replace_engine=True)
