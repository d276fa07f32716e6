"""The whole refinement with the CUDA back end, its kernels on the CPU, and what a CUDA graph needs of it."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from refine_engine import Mesh, RefineConfig, View, refine
from refine_engine.kernels import cpu, cuda
from refine_engine.method import loop
from refine_engine.method.config import Stage, Weights

# each waits for the card and brings a value to the host, by itself or to size its result
WAITING = {
    "_local_scalar_dense", "_unique2", "bincount", "equal", "masked_select", "nonzero", "repeat_interleave",
    "unique_consecutive", "unique_dim",
}  # fmt: skip


class Operators(TorchDispatchMode):
    """Counts the operators that run while it is entered."""

    def __init__(self) -> None:
        TorchDispatchMode.__init__(self)
        self.count: Counter[str] = Counter()

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        self.count[func.__name__.split(".")[0]] += 1
        return func(*args, **(kwargs or {}))


def config(iterations: int, preset: RefineConfig | None = None) -> RefineConfig:
    """All kernels are in use: the encoder is trained and the image symmetry weighs something."""
    return replace(
        preset or RefineConfig(),
        stages=(Stage(iterations, 32, 3e-3), Stage(iterations, 40, 1e-3)),
        proportions=None,
        agreement=None,
        weights=Weights(),
        encoder_size=64,
        train_encoder=True,
        symmetry_azimuths_degrees=(15.0,),
        symmetry_elevations_degrees=(45.0,),
    )


@pytest.fixture
def cuda_back_end(emulator: Any, monkeypatch: pytest.MonkeyPatch) -> Any:
    """`refine` on CPU tensors takes the functions of the CUDA back end, and the encoder on every pixel."""
    for name in ("optical_depth", "rasterize", "image_symmetry"):
        monkeypatch.setattr(cpu, name, getattr(cuda, name))
    dense = lambda network, silhouette, grid, train: lambda: network.features(silhouette, grid)  # noqa: E731
    monkeypatch.setattr(loop, "features_of", dense)
    return emulator


def test_refinement_by_the_cuda_back_end_follows_the_other(
    emulator: Any, octahedron_case: tuple[Mesh, list[View]], monkeypatch: pytest.MonkeyPatch
) -> None:
    mesh, views = octahedron_case
    by_cpu = refine(mesh, views, config(2))
    for name in ("optical_depth", "rasterize", "image_symmetry"):
        monkeypatch.setattr(cpu, name, getattr(cuda, name))
    by_cuda = refine(mesh, views, config(2))
    assert {"optical_depth", "optical_depth_backward", "image_symmetry", "resolve"} <= emulator.launched
    for name, losses in by_cpu.loss_curve.items():
        assert by_cuda.loss_curve[name] == pytest.approx(losses, rel=1e-3, abs=1e-6), name
    torch.testing.assert_close(by_cuda.mesh.vertices, by_cpu.mesh.vertices, rtol=0, atol=1e-4)


@pytest.mark.parametrize("preset", [RefineConfig(), RefineConfig.paper()], ids=["default", "paper"])
def test_an_iteration_never_waits_for_the_card(
    cuda_back_end: Any, octahedron_case: tuple[Mesh, list[View]], preset: RefineConfig
) -> None:
    """More iterations bring no more operators that wait: none of them is in the iteration."""
    mesh, views = octahedron_case
    counts = []
    for iterations in (1, 3):
        with Operators() as operators:
            refine(
                Mesh(mesh.vertices, mesh.faces), views, config(iterations, preset)
            )  # its box is not known yet
        counts.append(operators.count)
    few, many = counts
    assert many["convolution"] > few["convolution"] > 0  # the iterations themselves are counted
    assert {name: many[name] for name in WAITING} == {name: few[name] for name in WAITING}


def test_the_operators_that_wait_are_seen() -> None:
    with Operators() as operators:
        float(torch.ones(2).sum())
        torch.ones(2).nonzero()
        torch.ones(2)[torch.tensor([True, False])]
    assert operators.count["_local_scalar_dense"] == 1
    assert operators.count["nonzero"] >= 1
