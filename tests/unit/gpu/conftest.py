"""Runs cuda.cu on the CPU: the same text, compiled by g++ with a small header in the place of CUDA's.

What it shows: the arithmetic with fused multiply-adds, the indices, the argument lists, the grids and every
write within its buffer. What it cannot show: races between threads, the card's own expf and logf, and speed.
"""

from __future__ import annotations

import ctypes
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

from refine_engine import Camera, Mesh, View
from refine_engine.kernels import nvrtc

Bytes = NDArray[np.uint8]
HERE = Path(__file__).parent
GUARD = 256  # bytes on both sides of every buffer
CANARY = 0xA5
KERNEL = re.compile(r'extern "C" __global__ void (\w+)\(([^)]*)\)')


class Emulator:
    """Stands in for `nvrtc.launch` on CPU tensors."""

    def __init__(self, folder: Path) -> None:
        text = nvrtc.kernel_text()
        wrappers = []
        for name, parameters in KERNEL.findall(text):
            passed = ", ".join(p.split()[-1].lstrip("*") for p in parameters.split(","))
            wrappers.append(
                f'extern "C" void emulate_{name}(int x, int y, int block, bool backwards, {parameters}) {{\n'
                f"    emulator::run(x, y, block, backwards, [=] {{ {name}({passed}); }});\n}}\n"
            )
        source = folder / "emulated.cpp"
        source.write_text(f'#include "cuda_on_cpu.h"\n{text}\n{"".join(wrappers)}')
        macros = [f"-D{name}={value}" for name, value in nvrtc.MACROS]
        flags = ["-std=c++17", "-O2", "-Wall", "-Werror", "-Wno-unknown-pragmas", "-ffp-contract=fast"]
        if " fma " in Path("/proc/cpuinfo").read_text():  # of x86; others have it without being asked
            flags.append("-mfma")
        library = folder / "emulated.so"
        command = ["g++", *flags, *macros, f"-I{HERE}", "-shared", "-fPIC", str(source), "-o", str(library)]
        subprocess.run(command, check=True)
        self._library = ctypes.CDLL(str(library))
        self.kernels = [name for name, _ in KERNEL.findall(text)]
        self.backwards = False
        self.launched: set[str] = set()

    def launch(self, name: str, grid: tuple[int, int], *arguments: Tensor | int | float) -> None:
        """As `nvrtc.launch`; raises if the kernel wrote outside its tensors."""
        values: list[ctypes.c_int | ctypes.c_float | ctypes.c_void_p] = []
        guarded: list[tuple[Bytes, Bytes]] = []
        for argument in arguments:
            if isinstance(argument, Tensor):
                assert argument.is_contiguous()
                content = argument.detach().reshape(-1).view(torch.uint8).numpy()
                buffer = np.full(len(content) + 2 * GUARD, CANARY, np.uint8)
                buffer[GUARD : GUARD + len(content)] = content
                guarded.append((content, buffer))
                values.append(ctypes.c_void_p(buffer.ctypes.data + GUARD))
            else:
                values.append(
                    ctypes.c_int(argument) if isinstance(argument, int) else ctypes.c_float(argument)
                )
        block = nvrtc.BLOCK
        getattr(self._library, f"emulate_{name}")(*grid, block, ctypes.c_bool(self.backwards), *values)
        self.launched.add(name)
        for content, buffer in guarded:
            edges = np.concatenate([buffer[:GUARD], buffer[GUARD + len(content) :]])
            assert (edges == CANARY).all(), f"{name} wrote outside a buffer of {len(content)} bytes"
            content[:] = buffer[GUARD : GUARD + len(content)]


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
    monkeypatch.setattr(nvrtc, "launch", compiled.launch)
    return compiled


@pytest.fixture
def octahedron_case() -> tuple[Mesh, list[View]]:
    """An octahedron, twice subdivided, and a disc to fit it to."""
    corners = torch.tensor([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]]).float()
    triangles = [(a, b, c) for a in (0, 1) for b in (2, 3) for c in (4, 5)]
    points: list[torch.Tensor] = []
    faces = []
    for a, b, c in triangles:
        start = len(points)
        x, y, z = corners[a], corners[b], corners[c]
        points += [x, y, z, (x + y) / 2, (y + z) / 2, (z + x) / 2]
        faces += [[start + i for i in f] for f in ((0, 3, 5), (3, 1, 4), (5, 4, 2), (3, 4, 5))]
    unique, index = torch.stack(points).unique(dim=0, return_inverse=True)
    mesh = Mesh(0.4 * torch.nn.functional.normalize(unique, dim=1), index[torch.tensor(faces)])
    size = 64
    y, x = torch.meshgrid(torch.arange(size), torch.arange(size), indexing="ij")
    disc = (((x - 31.5) / 20) ** 2 + ((y - 31.5) / 14) ** 2 < 1).float()
    camera = Camera.look_at(20.0, 10.0, 1.9, 60.0, size, size)
    return mesh, [View(disc, camera)]
