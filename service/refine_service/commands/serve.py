"""`refine serve`: Redis, service and worker on this machine, in one command."""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import os
import signal
import sys
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import AsyncExitStack, ExitStack
from dataclasses import dataclass
from pathlib import Path

from refine_jobs.embedded import EmbeddedRedis
from refine_jobs.health import Health
from refine_jobs.redis_server import check_server, connect, connect_async
from refine_jobs.settings import OWNER_ONLY, JobSettings
from refine_jobs.slots import SlotState
from refine_proto.commands.ending import FAILED
from refine_proto.errors import Unavailable

from ..settings import ServiceSettings
from .arguments import add_listen_arguments, command, environment, make_parser

_STOP_S = 60.0  # the worker gives its jobs back and the service drains in less
_LOOK_S = 0.25
_SHOWN_LINES = 10  # of the log of a process that has ended by itself


def serve_parser() -> argparse.ArgumentParser:
    """The arguments of `refine serve`."""
    parser = make_parser("serve", "Run everything on this machine: Redis, the service and the worker.")
    add_listen_arguments(parser)
    parser.add_argument("--devices", help="for the worker: auto (the default), cpu, cuda, cuda:0,cuda:1")
    parser.add_argument("--slots-per-device", metavar="N", help="jobs at a time on one device")
    return parser


@command
def serve_command(argv: Sequence[str]) -> int:
    """Runs until SIGTERM or Ctrl-C (0), or until one of the processes ends by itself (1)."""
    values = environment(serve_parser().parse_args(argv))
    jobs = JobSettings.from_environment(values)
    os.umask(OWNER_ONLY)
    jobs.data_folder.mkdir(parents=True, exist_ok=True)
    jobs.data_folder.chmod(0o700)  # also where an earlier version has made it
    ServiceSettings.from_environment(values)  # tell now what the service could not read
    lifelines: tuple[int, ...] = ()
    with ExitStack() as stack:
        if jobs.redis_url is None:
            embedded = stack.enter_context(EmbeddedRedis(jobs.data_folder / "redis"))
            redis_url, lifelines = embedded.url, (embedded.lifeline,)
        else:
            redis_url = jobs.redis_url.get_secret_value()
            with connect(redis_url) as server:
                check_server(server, jobs.sync_submissions)
        values["REFINE_REDIS_URL"] = redis_url
        return asyncio.run(_supervise(values, jobs.data_folder, lifelines))


@dataclass(frozen=True)
class _Child:
    """A process of ours. It ends when its standard input closes, so it never outlives us."""

    name: str
    process: asyncio.subprocess.Process
    log: Path

    async def stop(self) -> None:
        """SIGTERM, and SIGKILL if that is not enough."""
        if self.process.returncode is None:
            self.process.terminate()
            try:
                await asyncio.wait_for(self.process.wait(), _STOP_S)
            except TimeoutError:
                self.process.kill()
                await self.process.wait()
        assert self.process.stdin is not None
        self.process.stdin.close()

    def last_lines(self) -> str:
        """The end of its log."""
        return "\n".join(self.log.read_text(errors="replace").splitlines()[-_SHOWN_LINES:])


async def _supervise(values: Mapping[str, str], folder: Path, lifelines: Sequence[int]) -> int:
    stop = asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, stop.set)
    async with AsyncExitStack() as stack:
        service = await _start("service", "refine_service", values, folder, lifelines, stack)
        worker = await _start("worker", "refine_worker", values, folder, lifelines, stack)
        showing = asyncio.create_task(_show(service, values["REFINE_REDIS_URL"], folder))
        ends = {asyncio.create_task(child.process.wait()): child for child in (service, worker)}
        stopped = asyncio.create_task(stop.wait())
        await asyncio.wait({stopped, *ends}, return_when=asyncio.FIRST_COMPLETED)
        for task in (showing, stopped):
            task.cancel()
        ended = [child for end, child in ends.items() if end.done()]
        if not stop.is_set():
            for child in ended:
                code = child.process.returncode
                print(
                    f"error: the {child.name} ended with code {code}; the end of {child.log}:",
                    file=sys.stderr,
                )
                print(child.last_lines(), file=sys.stderr)
        print("stopping", flush=True)
    return 0 if stop.is_set() else FAILED


async def _start(
    name: str,
    module: str,
    values: Mapping[str, str],
    folder: Path,
    lifelines: Sequence[int],
    stack: AsyncExitStack,
) -> _Child:
    """`lifelines`: of what must outlive it."""
    log = folder / f"{name}.log"
    # Their own sessions: Ctrl-C reaches us, and we stop them in order.
    with log.open("ab") as errors:
        process = await asyncio.create_subprocess_exec(
            *(sys.executable, "-m", module, "--stop-with-stdin"),
            env=dict(values),
            stdin=asyncio.subprocess.PIPE,
            stdout=asyncio.subprocess.PIPE if name == "service" else errors,
            stderr=errors,
            start_new_session=True,
            pass_fds=lifelines,
        )
    child = _Child(name, process, log)
    stack.push_async_callback(child.stop)
    return child


async def _show(service: _Child, redis_url: str, folder: Path) -> None:
    """Say where everything is, as it comes up."""
    assert service.process.stdout is not None
    words = (await service.process.stdout.readline()).decode().split()
    if len(words) != 4:
        return  # it ends by itself, which _supervise tells
    print(f"REST     {words[1]}  (a page for people; documentation: {words[1]}/docs)")
    print(f"gRPC     {words[3]}")
    print(f"data     {folder.resolve()}  (logs: service.log, worker.log)")
    print("slots    starting", flush=True)
    redis = connect_async(redis_url)
    try:
        devices = await _live_devices(Health(redis))
    finally:
        await redis.aclose()
    slots = ", ".join(f"{count} on {device}" for device, count in sorted(devices.items()))
    print(f"ready    slots: {slots}; Ctrl-C stops", flush=True)


async def _live_devices(health: Health) -> Counter[str]:
    """How many slots each device has, once none of them is starting."""
    while True:
        with contextlib.suppress(Unavailable):
            slots = await health.slots()
            if slots and all(slot.state is not SlotState.STARTING for slot in slots):
                return Counter(slot.device for slot in slots)
        await asyncio.sleep(_LOOK_S)
