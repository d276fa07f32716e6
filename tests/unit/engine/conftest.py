"""Small meshes that the tests refine."""

import numpy as np
import pytest
import torch
import trimesh

from refine_engine.values import Mesh


@pytest.fixture
def ball() -> Mesh:
    """Radius 0.5 about the origin, 162 vertices."""
    shape = trimesh.creation.icosphere(subdivisions=2, radius=0.5)
    return Mesh(
        torch.from_numpy(np.array(shape.vertices, np.float32)),
        torch.from_numpy(np.array(shape.faces, np.int64)),
    )
