"""Compiles the CUDA kernels for the card at hand and launches them on torch's current stream.

The text is compiled by NVRTC, which every CUDA build of torch brings, through cuda.core, NVIDIA's Python API:
no nvcc and no C compiler. The machine code is kept in cuda.core's cache folder of the user
($XDG_CACHE_HOME/cuda-python), by the text, the options, the architecture and the NVRTC version.
"""

from __future__ import annotations

from functools import lru_cache
from importlib import resources
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from ..errors import RefineError
from .oracle import CUTOFF, FLAT, LEAST_CONFIDENCE, NEAR

if TYPE_CHECKING:
    from cuda.core import Kernel, ObjectCode
    from cuda.core.utils import ProgramCacheResource

LANES = 32  # threads of a warp, which takes one face of one view
BLOCK = 4 * LANES  # threads of a block, for every kernel
FRACTION_BITS = 32  # of the fixed-point optical depth
QUERIES = 4  # of a thread in nearest_point
MACROS = [
    ("CUTOFF", f"{CUTOFF!r}f"),
    ("FLAT", f"{FLAT!r}f"),
    ("LEAST_CONFIDENCE", f"{LEAST_CONFIDENCE!r}f"),
    ("NEAR", f"{NEAR!r}f"),
    ("FRACTION_BITS", str(FRACTION_BITS)),
    ("LANES", str(LANES)),
    ("QUERIES", str(QUERIES)),
]


def kernel_text() -> str:
    """cuda.cu, as installed."""
    return resources.files(__package__).joinpath("cuda.cu").read_text(encoding="utf-8")


def compile_kernels(architecture: str, cache: ProgramCacheResource | None = None) -> ObjectCode:
    """The kernels as machine code for `architecture` (such as "sm_90"). Needs NVRTC, no card, no driver."""
    from cuda.core import Program, ProgramOptions

    options = ProgramOptions(arch=architecture, std="c++17", define_macro=MACROS)
    return Program(kernel_text(), "c++", options).compile("cubin", cache=cache)


def user_cache() -> ProgramCacheResource | None:
    """The user's folder of compiled kernels; None where it cannot be written: then each process compiles."""
    from cuda.core.utils import FileStreamProgramCache

    try:
        return FileStreamProgramCache()
    except OSError:
        return None


@lru_cache(maxsize=8)
def _compiled(architecture: str) -> ObjectCode:
    """Raises RefineError: something is missing or too old for this card."""
    cuda = torch.version.cuda or "none"
    try:
        return compile_kernels(architecture, user_cache())
    except ImportError as missing:
        raise RefineError(
            f"expected cuda-core and cuda-bindings for this torch (built for CUDA {cuda}), got: {missing}; "
            f"next: pip install cuda-core 'cuda-bindings=={cuda.split('.')[0]}.*'"
        ) from missing
    except Exception as failure:  # those of cuda.core and cuda.pathfinder have no class in common
        raise RefineError(
            f"expected an NVRTC that compiles for this card ({architecture}), "
            f"got {type(failure).__name__}: {' '.join(str(failure).split())}; next: install the newest torch "
            f"built for CUDA, which brings its NVRTC (this one is built for CUDA {cuda})"
        ) from failure


@lru_cache(maxsize=64)
def _kernel(name: str, device: int) -> Kernel:
    major, minor = torch.cuda.get_device_capability(device)
    return _compiled(f"sm_{major}{minor}").get_kernel(name)


def launch(name: str, grid: tuple[int, int], *arguments: Tensor | int | float) -> None:
    """Queue one kernel, blocks of BLOCK threads, on the current stream of the device of its tensors.

    Tensors are passed as addresses and must be contiguous; an int becomes a C int, a float a C float.
    """
    device = next(a.device for a in arguments if isinstance(a, Tensor))
    values = [as_argument(a, device) for a in arguments]
    with torch.cuda.device(device):
        kernel = _kernel(name, torch.cuda.current_device())
        from cuda import core  # after _kernel, which says what to install

        core.launch(torch.cuda.current_stream(), core.LaunchConfig(grid=grid, block=BLOCK), kernel, *values)


def as_argument(argument: Tensor | int | float, device: torch.device) -> int | np.int32 | np.float32:
    """What cuda.core passes on unchanged: a Python int is an address to it, a numpy scalar a C value."""
    if isinstance(argument, int):
        return np.int32(argument)
    if isinstance(argument, float):
        return np.float32(argument)
    if not argument.is_contiguous() or argument.device != device:
        raise ValueError(
            f"expected contiguous tensors on {device}, got strides {argument.stride()} on {argument.device}"
        )
    return argument.data_ptr()
