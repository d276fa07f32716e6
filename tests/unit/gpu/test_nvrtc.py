"""The kernels compile for every generation of cards by NVRTC, without a card, and are kept."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from refine_engine.errors import RefineError
from refine_engine.kernels import nvrtc

SYMBOLS = ["optical_depth", "optical_depth_backward", "gather_corners", "rasterize", "resolve"]
SYMBOLS += ["image_symmetry", "nearest_point"]


@pytest.fixture
def compiler() -> None:
    reason = "NVRTC is not installed: it comes with a CUDA build of torch, or on Linux with the extra [dev]"
    pytest.importorskip("cuda.core", reason=reason)
    from cuda.pathfinder import DynamicLibNotFoundError, load_nvidia_dynamic_lib

    try:
        load_nvidia_dynamic_lib("nvrtc")
    except DynamicLibNotFoundError:
        pytest.skip(reason)


@pytest.mark.usefixtures("compiler")
@pytest.mark.parametrize("architecture", ["sm_80", "sm_90", "sm_100"])
def test_kernels_compile(architecture: str) -> None:
    code = bytes(nvrtc.compile_kernels(architecture).code)
    assert code.startswith(b"\x7fELF")
    for symbol in SYMBOLS:
        assert f".text.{symbol}\0".encode() in code


@pytest.mark.usefixtures("compiler")
def test_compiled_kernels_are_kept_by_text_and_architecture(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from cuda.core.utils import FileStreamProgramCache

    cache = FileStreamProgramCache(tmp_path)
    first = bytes(nvrtc.compile_kernels("sm_80", cache).code)
    assert bytes(nvrtc.compile_kernels("sm_80", cache).code) == first
    assert len(cache) == 1
    nvrtc.compile_kernels("sm_90", cache)
    assert len(cache) == 2
    changed = nvrtc.kernel_text().replace("TINY = 1e-12f", "TINY = 1e-11f")
    monkeypatch.setattr(nvrtc, "kernel_text", lambda: changed)
    assert bytes(nvrtc.compile_kernels("sm_80", cache).code) != first
    assert len(cache) == 3


@pytest.mark.usefixtures("compiler")
def test_the_cache_is_in_the_users_folder_and_can_be_missing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    cache = nvrtc.user_cache()
    assert cache is not None
    nvrtc.compile_kernels("sm_90", cache)
    assert any(path.is_file() for path in tmp_path.rglob("*"))
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    assert nvrtc.user_cache() is None


def test_a_missing_package_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "cuda.core", None)
    monkeypatch.setitem(sys.modules, "cuda.core.utils", None)
    monkeypatch.setattr(torch.version, "cuda", "12.6")
    nvrtc._compiled.cache_clear()
    with pytest.raises(RefineError, match=r"pip install cuda-core 'cuda-bindings==12\.\*'"):
        nvrtc._compiled("sm_90")


@pytest.mark.usefixtures("compiler")
def test_an_nvrtc_that_does_not_know_the_card_is_told() -> None:
    nvrtc._compiled.cache_clear()
    with pytest.raises(
        RefineError, match=r"NVRTC that compiles for this card \(sm_999\), got NVRTCError: .*arch"
    ):
        nvrtc._compiled("sm_999")


def test_a_missing_nvrtc_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    pathfinder = pytest.importorskip("cuda.pathfinder", reason="cuda-core is installed on Linux only")

    def compile_kernels(*_: object) -> None:
        raise pathfinder.DynamicLibNotFoundError("Failure finding libnvrtc.so.13:\nNo such file")

    monkeypatch.setattr(nvrtc, "compile_kernels", compile_kernels)
    monkeypatch.setattr(torch.version, "cuda", "13.0")
    nvrtc._compiled.cache_clear()
    with pytest.raises(RefineError) as error:
        nvrtc._compiled("sm_90")
    assert str(error.value) == (
        "expected an NVRTC that compiles for this card (sm_90), "
        "got DynamicLibNotFoundError: Failure finding libnvrtc.so.13: No such file; next: install the newest "
        "torch built for CUDA, which brings its NVRTC (this one is built for CUDA 13.0)"
    )


def test_arguments_are_passed_as_c_values() -> None:
    cpu = torch.device("cpu")
    values: list[Any] = [nvrtc.as_argument(value, cpu) for value in (3, 0.5)]
    assert [type(value) for value in values] == [np.int32, np.float32]
    tensor = torch.zeros(4, 6)
    assert nvrtc.as_argument(tensor, cpu) == tensor.data_ptr()
    with pytest.raises(ValueError, match="contiguous"):
        nvrtc.as_argument(tensor.T, cpu)
    with pytest.raises(ValueError, match="meta"):
        nvrtc.as_argument(tensor.to("meta"), cpu)
    with pytest.raises(OverflowError):
        nvrtc.as_argument(2**31, cpu)
