"""What parsing may cost: the limits hold in Python and in native code, and are gone afterwards."""

from __future__ import annotations

import resource
import signal
import subprocess
import sys

import pytest

from refine_engine.errors import MeshInvalid
from refine_worker.engine.limits import parsing

KINDS = (resource.RLIMIT_CPU, resource.RLIMIT_AS)
NATIVE = """
from refine_worker.engine.limits import parsing
with parsing(0.05, 2**30):
    sum(range(10**15))
"""


def parse_for_ever() -> None:
    """And tell every error in words of its own."""
    while True:
        try:
            while True:
                pass
        except Exception as error:
            raise ValueError("damaged") from error


def test_python_that_takes_too_long_is_stopped_where_it_is() -> None:
    before = [resource.getrlimit(kind) for kind in KINDS]
    with pytest.raises(MeshInvalid, match=r"read in 0\.05 s"), parsing(0.05, 2**30):
        parse_for_ever()
    assert [resource.getrlimit(kind) for kind in KINDS] == before
    assert signal.getitimer(signal.ITIMER_PROF) == (0.0, 0.0)


def test_native_code_that_does_not_come_back_is_ended_by_the_system() -> None:
    ended = subprocess.run([sys.executable, "-c", NATIVE], capture_output=True)
    assert ended.returncode == -signal.SIGXCPU, ended.stderr


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux keeps to it")
def test_memory_has_an_end() -> None:
    with pytest.raises(MemoryError), parsing(60, 2**24):
        bytearray(2**28)
    assert len(bytearray(2**28)) == 2**28
