"""A network's outputs in a folder, one mesh per instance, under the names and in the frames of the networks.

OccNet      generation/meshes/<category>/<instance>.off; the object's box centred, its longest side 1
Pixel2Mesh  <category>/<instance>/rendering/<view>.obj, or <view>.3.obj for the third stage of the PyTorch
            port; in the axes of the input camera
AtlasNet    <instance>AtlasnetReconstruction.ply; the object's surface points centred, the farthest at 1
others      <category>/<instance>.<suffix> or <instance>.<suffix>, with any suffix that the engine reads

Sources: generate.py of autonomousvision/occupancy_networks, functions/predictor.py of noahcao/Pixel2Mesh,
doc/demo.md of ThibaultGROUEIX/AtlasNet.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

import numpy as np
import torch
from torch import Tensor

from refine_engine.scores.scores import sample_surface
from refine_engine.values import Camera, Mesh
from refine_proto.formats import MESH_SUFFIXES

from .cases import CaseUnavailable, read_mesh_file

Frame = Literal["world", "unit_box", "unit_ball", "pixel2mesh"]
FRAMES: tuple[Frame, ...] = get_args(Frame)
TAILS = (*MESH_SUFFIXES, ".3.obj", "_predict.obj", "AtlasnetReconstruction.ply")
PIXEL2MESH_UNIT = 1.75  # its outputs are ShapeNet lengths / 1.75 (x 0.57 in its data preparation)
PIXEL2MESH_CENTRE = (
    0.0,
    0.0,
    -0.8,
)  # mesh_pos: the port's outputs are relative to it, the original's absolute
BALL_SAMPLES = 10_000


@dataclass(frozen=True)
class CoarseFolder:
    """Where a network's outputs lie and in which frame they are.

    world       the frame of the data set
    unit_box    centred on the ground truth's box, whose longest side is 1 (OccNet)
    unit_ball   centred on the ground truth's surface points, the farthest of which is at 1 (AtlasNet)
    pixel2mesh  the input camera's axes (+X right, +Y up, -Z forward), lengths / 1.75
    """

    folder: Path
    frame: Frame = "world"

    def load(
        self, category: str, instance: str, view: str, camera: Camera, ground_truth: Mesh | None
    ) -> Mesh:
        """The coarse mesh of an instance, in the data set's frame; raises CaseUnavailable without one."""
        path = self.find(category, instance, view)
        mesh = read_mesh_file(path)
        return Mesh(self._to_world(mesh.vertices, path, camera, ground_truth), mesh.faces)

    def find(self, category: str, instance: str, view: str) -> Path:
        stems = [
            f"{category}/{instance}", instance, f"{category}/{instance}_{view}", f"{instance}_{view}",
            f"{category}_{instance}", f"{category}_{instance}_{view}",
            f"{category}/{instance}/rendering/{view}", f"{category}/{instance}/{view}",
        ]  # fmt: skip
        for stem in stems:
            for tail in TAILS:
                if (path := self.folder / (stem + tail)).is_file():
                    return path
        raise CaseUnavailable(
            f"expected a coarse mesh of {category}/{instance} in {self.folder}, for instance "
            f"{category}/{instance}.off (OccNet), {category}/{instance}/rendering/{view or 'VIEW'}.obj "
            f"(Pixel2Mesh) or {instance}AtlasnetReconstruction.ply (AtlasNet); got none of these"
        )

    def _to_world(self, vertices: Tensor, path: Path, camera: Camera, ground_truth: Mesh | None) -> Tensor:
        if self.frame == "world":
            return vertices
        if self.frame == "pixel2mesh":
            return _from_pixel2mesh(vertices, camera, relative=path.name.endswith(".3.obj"))
        if ground_truth is None:
            raise CaseUnavailable(
                f"expected a ground truth to place a mesh of the frame {self.frame}, got none"
            )
        centre, unit = _unit_box(ground_truth) if self.frame == "unit_box" else _unit_ball(ground_truth)
        return vertices * unit + centre


def _unit_box(mesh: Mesh) -> tuple[Tensor, float]:
    used = mesh.vertices[mesh.faces.unique()]
    low, high = used.amin(0), used.amax(0)
    return (low + high) / 2, float((high - low).max())


def _unit_ball(mesh: Mesh) -> tuple[Tensor, float]:
    triangles = mesh.vertices.double()[mesh.faces].numpy()
    points = sample_surface(triangles, BALL_SAMPLES, np.random.default_rng(0))
    centre = points.mean(0)
    return torch.from_numpy(centre).float(), float(np.linalg.norm(points - centre, axis=1).max())


def _from_pixel2mesh(vertices: Tensor, camera: Camera, relative: bool) -> Tensor:
    """Camera axes of OpenGL -> world."""
    absolute = vertices + torch.tensor(PIXEL2MESH_CENTRE) if relative else vertices
    opencv = absolute * torch.tensor([1.0, -1.0, -1.0]) * PIXEL2MESH_UNIT
    rotation, translation = camera.world_to_camera[:3, :3], camera.world_to_camera[:3, 3]
    return (opencv - translation) @ rotation
