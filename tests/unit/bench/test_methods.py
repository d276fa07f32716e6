"""The baselines optimise what they claim, plug-ins are called as promised, a server gets what it can read."""

import json
import sys
import types
from collections.abc import Mapping
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from scipy.sparse.linalg import splu

from refine_bench import baselines
from refine_bench.cases import Case, Plane, Scene, SetInvalid, mesh_of
from refine_bench.methods import WITHOUT, ablation, applies, make_method, told
from refine_bench.remote import ServerMethod
from refine_engine import RefineConfig, make_artifacts, read_camera, read_inputs
from refine_engine.cameras.seen import hard_silhouette, silhouette_iou
from refine_engine.method.config import Stage
from refine_engine.method.topology import Topology
from refine_engine.values import Camera, Mesh, View

SHORT = replace(RefineConfig.paper(), stages=(Stage(25, 96, 1e-3),))


def scene() -> Scene:
    """A ball seen as a ball, reconstructed 12 % too small."""
    truth = mesh_of(trimesh.creation.icosphere(2, 0.4))
    camera = Camera.look_at(30.0, 20.0, 1.6, 60.0, 96, 96)
    coarse = Mesh(truth.vertices * 0.88, truth.faces)
    return Scene(coarse, View(hard_silhouette(truth, camera).float(), camera), truth)


def case(asymmetric: bool = False) -> Case:
    return Case("ball", "ball", scene, asymmetric=asymmetric)


@pytest.mark.parametrize("name", ["vertices_adam", "vertices_large_steps"])
def test_baselines_follow_the_silhouette(name: str) -> None:
    weights = replace(SHORT.weights, displacement=0.0, normal_consistency=1.0, laplacian=1.0)
    config = replace(SHORT, weights=weights, stages=(Stage(60, 96, 3e-4),))
    outcome = make_method(name, config)(case(), scene(), 0)
    before, after = (silhouette_iou(mesh, scene().view) for mesh in (scene().coarse, outcome.mesh))
    assert after > before + 0.03
    assert len(outcome.loss_curve) == 60
    assert min(outcome.loss_curve) < outcome.loss_curve[0]
    assert outcome.confidence is not None
    assert outcome.confidence.shape == (len(outcome.mesh.vertices),)
    assert torch.equal(outcome.mesh.faces, scene().coarse.faces)


def test_large_steps_solve_their_system_forwards_and_backwards() -> None:
    mesh = scene().coarse
    topology = Topology.of(mesh.faces, len(mesh.vertices))
    matrix = baselines._system(topology, len(mesh.vertices)).toarray()
    edges = topology.edges.numpy()
    expected = np.eye(len(matrix))
    for i, j in edges:
        expected[[i, j], [i, j]] += baselines.LARGE_STEPS_LAMBDA
        expected[[i, j], [j, i]] -= baselines.LARGE_STEPS_LAMBDA
    assert np.allclose(matrix, expected)
    positions, _ = baselines.large_step(topology, mesh.vertices)
    assert torch.allclose(positions(), mesh.vertices, atol=1e-5)
    u = torch.randn(len(matrix), 3, generator=torch.Generator().manual_seed(0), requires_grad=True)
    factor = splu(baselines._system(topology, len(matrix)).tocsc())
    baselines._Solve.apply(u, factor).square().sum().backward()
    inverse = np.linalg.inv(expected)
    assert u.grad is not None
    assert np.allclose(u.grad.numpy(), 2 * inverse @ (inverse @ u.detach().numpy()), atol=1e-5)


def test_large_steps_move_smoothly_where_adam_does_not() -> None:
    """One step on a gradient that pulls a single vertex."""
    mesh = scene().coarse
    topology = Topology.of(mesh.faces, len(mesh.vertices))
    moved = {}
    for name, step in (("adam", baselines.adam_step), ("large", baselines.large_step)):
        positions, update = step(topology, mesh.vertices)
        positions()[7, 0].backward()
        update(1)
        moved[name] = (positions() - mesh.vertices).detach().norm(dim=1) > 1e-6
    assert moved["adam"].sum() == 1
    assert moved["large"].sum() > 20


def test_ablation_switches_terms_off_group_by_group() -> None:
    names = ["silhouette", "smoothness", "vertex_symmetry", "all", "confidence_cost_1"]
    assert ablation(RefineConfig.paper()) == names
    assert ablation(RefineConfig()) == ["proportions", *names]
    off = [set(WITHOUT[name]) for name in WITHOUT]
    assert all(later < earlier for earlier, later in pairwise(off))
    curves = {
        name: make_method(name, replace(SHORT, stages=(Stage(2, 56, 1e-3),)))(case(), scene(), 0).loss_curve
        for name in ("silhouette", "all")
    }
    assert 0 < curves["silhouette"][0] < curves["all"][0]
    assert applies("all", case())
    assert not applies("confidence_cost_1", case())
    assert applies("confidence_cost_1", case(asymmetric=True))


def test_ablation_adds_the_image_symmetry_that_the_default_leaves_out() -> None:
    config = replace(RefineConfig(), stages=(Stage(2, 56, 1e-3),), proportions=None, agreement=None, seed=1)
    curves = {
        name: make_method(name, config)(case(), scene(), 0).loss_curve
        for name in ("refine", "silhouette", "vertex_symmetry", "all")
    }
    assert curves["refine"] == curves["vertex_symmetry"]
    first, second = ({name: curve[i] for name, curve in curves.items()} for i in (0, 1))
    assert 0 < first["silhouette"] < first["vertex_symmetry"] == first["all"]  # a ball is its mirror image
    assert second["silhouette"] < second["vertex_symmetry"] < second["all"]


@pytest.mark.parametrize("name", ["refine", "proportions", "vertices_adam"])
def test_a_mesh_that_agrees_is_kept_by_every_method_of_a_preset(name: str) -> None:
    near = replace(scene(), coarse=Mesh(scene().coarse.vertices * 0.99 / 0.88, scene().coarse.faces))
    outcome = make_method(name, RefineConfig())(case(), near, 0)
    assert torch.equal(outcome.mesh.vertices, near.coarse.vertices)
    assert outcome.loss_curve == ()


def test_the_fit_of_the_whole_mesh_alone_grows_the_ball() -> None:
    outcome = make_method("proportions", RefineConfig())(case(), scene(), 0)
    assert silhouette_iou(outcome.mesh, scene().view) > 0.95
    assert outcome.loss_curve == ()


def test_baselines_of_the_default_end_as_the_engine_does() -> None:
    config = replace(RefineConfig(), stages=(Stage(3, 56, 1e-3),))
    outcome = make_method("vertices_adam", config)(case(), scene(), 0)
    assert silhouette_iou(outcome.mesh, scene().view) > silhouette_iou(scene().coarse, scene().view)
    assert len(outcome.loss_curve) == 3


def test_a_plugin_gets_mesh_silhouette_and_camera(monkeypatch: pytest.MonkeyPatch) -> None:
    def grow(mesh: Mesh, silhouette: torch.Tensor, camera: Camera) -> Mesh:
        assert silhouette.shape == (camera.height, camera.width)
        return Mesh(mesh.vertices / 0.88, mesh.faces)

    module = types.ModuleType("my_method")
    monkeypatch.setattr(module, "grow", grow, raising=False)
    monkeypatch.setitem(sys.modules, "my_method", module)
    outcome = make_method("my_method:grow", SHORT)(case(), scene(), 0)
    assert silhouette_iou(outcome.mesh, scene().view) > 0.99
    for wrong in ("my_method:shrink", "no_such_module:f", "nonsense"):
        with pytest.raises(SetInvalid, match="expected a method among refine, paper, default"):
            make_method(wrong, SHORT)


@dataclass(frozen=True)
class Answer:
    refinement: Any
    files: Mapping[str, Path]


class InProcess:
    """The engine behind the interface of RefineClient: reads the sent bytes as the worker does."""

    options: Mapping[str, Any]

    def list(self, *, limit: int | None = None) -> None:
        return None

    def refine(
        self,
        mesh: bytes,
        silhouette: bytes,
        camera: Mapping[str, Any],
        directory: Path,
        options: Mapping[str, Any],
    ) -> Answer:
        json.dumps([camera, options])  # what is sent is JSON
        inputs = read_inputs(mesh, "mesh", silhouette, read_camera(camera))
        self.options = options
        config = replace(SHORT, seed=options["seed"])
        artifacts = make_artifacts(inputs, inputs.refine(config), config)
        for name, data in artifacts.items():
            (directory / name).write_bytes(data)
        start = datetime(2026, 1, 1, tzinfo=UTC)
        times = types.SimpleNamespace(
            created_at=start,
            started_at=start + timedelta(seconds=2),
            finished_at=start + timedelta(seconds=5),
            mirror_plane=None,
        )
        return Answer(times, {name: directory / name for name in artifacts})


def test_a_server_is_told_the_plane_only_when_methods_are() -> None:
    client, sideways = InProcess(), replace(case(), plane=Plane((1.0, 0.0, 0.0)))
    for heard, sent in ((True, {"symmetry_normal": [1.0, 0.0, 0.0]}), (False, {})):
        ServerMethod(client, "paper")(replace(sideways, plane_told=heard), scene(), 3)
        assert client.options == {"preset": "paper", "seed": 3, **sent}


def test_a_plane_that_is_told_is_not_looked_for() -> None:
    sideways = replace(case(), plane=Plane((1.0, 0.0, 0.0)))
    assert told(RefineConfig(), sideways) == RefineConfig()
    config = told(RefineConfig(), replace(sideways, plane_told=True))
    assert (config.symmetry, config.symmetry_normal) == ("plane", (1.0, 0.0, 0.0))


def test_a_server_is_sent_what_it_reads_and_gives_what_the_engine_gives() -> None:
    server = ServerMethod(InProcess(), "default")
    outcome = server(case(), scene(), 3)
    local = make_method("refine", SHORT)(case(), scene(), 3)
    assert outcome.confidence is not None
    assert (outcome.seconds, outcome.queue_s) == (3.0, 2.0)
    assert len(outcome.loss_curve) == 25
    assert torch.allclose(outcome.mesh.vertices.sort(0).values, local.mesh.vertices.sort(0).values, atol=1e-5)
    summary = server.summary()
    assert (summary["refinements"], summary["queue_s_median"], summary["running_s_mean"]) == (1, 2.0, 3.0)
    assert summary["refinements_per_minute"] == pytest.approx(60 / summary["wall_s"], rel=0.01)
