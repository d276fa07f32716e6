"""Runs kernels.cu on the CPU: the same text, compiled by g++ with a small header in the place of CUDA's.

What it shows: the arithmetic, the indices, the argument lists, the grids and every write within its buffer.
What it cannot show: races between threads, the card's own rounding (fused multiply-add, expf) and speed.
"""

from __future__ import annotations

import ctypes
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from torch import Tensor

from refine_engine.silhouette import device_code

HERE = Path(__file__).parent
GUARD = 256  # bytes on both sides of every buffer
CANARY = 0xA5
KERNEL = re.compile(r'extern "C" __global__ void (\w+)\(([^)]*)\)')


class Emulator:
    """Stands in for `device_code.launch` on CPU tensors."""

    def __init__(self, folder: Path) -> None:
        text = device_code.kernel_text()
        wrappers = []
        for name, parameters in KERNEL.findall(text):
            passed = ", ".join(p.split()[-1].lstrip("*") for p in parameters.split(","))
            wrappers.append(
                f'extern "C" void emulate_{name}(int x, int y, int block, bool backwards, {parameters}) {{\n'
                f"    emulator::run(x, y, block, backwards, [=] {{ {name}({passed}); }});\n}}\n"
            )
        source = folder / "emulated.cpp"
        source.write_text(f'#include "cuda_on_cpu.h"\n{text}\n{"".join(wrappers)}')
        macros = [f"-D{name}={value}" for name, value in device_code.MACROS]
        flags = ["-std=c++17", "-O2", "-ffp-contract=off", "-Wall", "-Werror", "-Wno-unknown-pragmas"]
        library = folder / "emulated.so"
        command = ["g++", *flags, *macros, f"-I{HERE}", "-shared", "-fPIC", str(source), "-o", str(library)]
        subprocess.run(command, check=True)
        self._library = ctypes.CDLL(str(library))
        self.kernels = [name for name, _ in KERNEL.findall(text)]
        self.backwards = False
        self.launched: set[str] = set()

    def launch(self, name: str, grid: tuple[int, int], *arguments: Tensor | int | float) -> None:
        """As `device_code.launch`; raises if the kernel wrote outside its tensors."""
        values: list[ctypes.c_int | ctypes.c_float | ctypes.c_void_p] = []
        guarded: list[tuple[Tensor, Tensor]] = []
        for argument in arguments:
            if isinstance(argument, Tensor):
                assert argument.is_contiguous()
                content = argument.reshape(-1).view(torch.uint8)
                buffer = torch.full((len(content) + 2 * GUARD,), CANARY, dtype=torch.uint8)
                buffer[GUARD : GUARD + len(content)] = content
                guarded.append((content, buffer))
                values.append(ctypes.c_void_p(buffer.data_ptr() + GUARD))
            else:
                values.append(
                    ctypes.c_int(argument) if isinstance(argument, int) else ctypes.c_float(argument)
                )
        block = device_code.BLOCK
        getattr(self._library, f"emulate_{name}")(*grid, block, ctypes.c_bool(self.backwards), *values)
        self.launched.add(name)
        for content, buffer in guarded:
            edges = torch.cat([buffer[:GUARD], buffer[GUARD + len(content) :]])
            assert bool((edges == CANARY).all()), f"{name} wrote outside a buffer of {len(content)} bytes"
            content.copy_(buffer[GUARD : GUARD + len(content)])


@pytest.fixture(scope="session")
def compiled(tmp_path_factory: pytest.TempPathFactory) -> Emulator:
    """The kernels for the CPU, compiled once."""
    if shutil.which("g++") is None or not sys.platform.startswith("linux"):
        pytest.skip("the emulator of the CUDA kernels needs g++ on Linux; NVRTC and a card need neither")
    return Emulator(tmp_path_factory.mktemp("emulator"))


@pytest.fixture
def emulator(compiled: Emulator, monkeypatch: pytest.MonkeyPatch) -> Emulator:
    """The CUDA back end launches its kernels on the CPU, so that it takes CPU tensors."""
    compiled.backwards = False
    compiled.launched = set()
    monkeypatch.setattr(device_code, "launch", compiled.launch)
    return compiled
