"""Two network namespaces as two machines: Redis, S3 and service on one, worker and caller on the other."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from refine_jobs.embedded import find_server

SAMPLE = Path(__file__).parents[2] / "examples/samples/chair"
HOST = "10.177.0.1"  # of the machine with Redis, S3 and the service; inside the namespaces only
EDGE, WORKER = (f"refine-{name}-{os.getpid()}" for name in ("edge", "work"))
SETTINGS = {
    "REFINE_REDIS_URL": f"redis://{HOST}:6379",
    "REFINE_BLOB_URL": "s3://refine/two-machines",
    "REFINE_HOST": HOST,
    "REFINE_REQUIRE_KEY": "false",
    "REFINE_SERVER": f"http://{HOST}:8000",
    "REFINE_DEVICES": "cpu",
    "REFINE_SLOTS_PER_DEVICE": "1",
    "AWS_ENDPOINT_URL": f"http://{HOST}:5000",
    "AWS_ALLOW_HTTP": "true",
    "AWS_ACCESS_KEY_ID": "test",
    "AWS_SECRET_ACCESS_KEY": "test",
    "AWS_REGION": "us-east-1",
}


def ip(*words: str) -> int:
    return subprocess.run(["ip", *words], capture_output=True).returncode


@pytest.fixture
def machines() -> Iterator[None]:
    if os.getuid() != 0 or shutil.which("ip") is None or ip("netns", "add", EDGE) != 0:
        pytest.skip("needs root and `ip netns` (Debian: iproute2), which makes the two machines")
    try:
        assert ip("netns", "add", WORKER) == 0
        commands = (
            f"-n {EDGE} link add wire type veth peer name wire netns {WORKER}",
            f"-n {EDGE} addr add {HOST}/24 dev wire",
            f"-n {WORKER} addr add 10.177.0.2/24 dev wire",
            *(
                f"-n {machine} link set {device} up"
                for machine in (EDGE, WORKER)
                for device in ("lo", "wire")
            ),
        )
        assert [command for command in commands if ip(*command.split()) != 0] == []
        yield
    finally:
        for machine in (EDGE, WORKER):
            ip("netns", "del", machine)


class Machine:
    """Starts programs in one namespace, each in a folder of its own, and stops them at the end."""

    def __init__(self, name: str, folder: Path, stack: ExitStack) -> None:
        self._inside = ["ip", "netns", "exec", name]
        self._folder, self._stack = folder, stack
        self._environment = os.environ | SETTINGS | {"REFINE_DATA_FOLDER": str(folder / f"{name}-data")}
        folder.mkdir(exist_ok=True)

    def start(self, *command: str) -> subprocess.Popen[bytes]:
        log = self._stack.enter_context((self._folder / f"{time.monotonic_ns()}.log").open("wb"))
        process = subprocess.Popen(
            [*self._inside, *command], env=self._environment, cwd=self._folder, stdout=log, stderr=log
        )
        self._stack.callback(process.wait, 60)
        self._stack.callback(process.terminate)
        return process

    def run(self, *command: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [*self._inside, *command], env=self._environment, capture_output=True, text=True, timeout=300
        )

    def wait_for(self, url: str, method: str = "GET") -> None:
        code = (
            "import sys, urllib.request; "
            "urllib.request.urlopen(urllib.request.Request(sys.argv[1], method=sys.argv[2]), timeout=5)"
        )
        for _ in range(100):
            answer = self.run(sys.executable, "-c", code, url, method)
            if answer.returncode == 0:
                return
            time.sleep(0.2)
        logs = "".join(path.read_text() for path in self._folder.glob("*.log"))
        raise AssertionError(f"{url} does not answer: {answer.stderr}\n{logs}")


@pytest.mark.usefixtures("machines")
def test_a_worker_on_another_machine_refines(tmp_path: Path) -> None:
    with ExitStack() as stack:
        edge = Machine(EDGE, tmp_path / "edge", stack)
        work = Machine(WORKER, tmp_path / "work", stack)
        edge.start(find_server(), "--bind", HOST, "--protected-mode", "no", "--appendonly", "yes")
        edge.start(sys.executable, "-m", "moto.server", "-H", HOST, "-p", "5000")
        edge.wait_for(f"http://{HOST}:5000/refine", "PUT")
        edge.start(sys.executable, "-m", "refine_service")
        work.wait_for(f"http://{HOST}:8000/readyz")
        work.start(sys.executable, "-m", "refine_worker")
        done = work.run(
            *(sys.executable, "-m", "refine_client", "submit"),
            *(str(SAMPLE / "coarse.obj"), str(SAMPLE / "silhouette.png")),
            *("--camera", str(SAMPLE / "camera.json"), "--iterations", "10", "-o", str(tmp_path / "out")),
        )
        assert done.returncode == 0, done.stderr
    assert (tmp_path / "out/refined.glb").read_bytes()[:4] == b"glTF"
