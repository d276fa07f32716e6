"""What becomes a mesh on the server: archives with materials, points, voxels, over both transports."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from PIL import Image
from sample import CAMERA, MESH, OPTIONS, SILHOUETTE
from serve_process import Served

from refine_client import RefineClient
from refine_proto.models import MeshFormat, State

COARSE: Any = trimesh.load_mesh(MESH, process=False)


def archive() -> bytes:
    """The mesh with a texture."""
    vertices, uv = COARSE.vertices, COARSE.vertices[:, :2] - COARSE.vertices[:, :2].min(0)
    lines = ["mtllib table.mtl", "usemtl wood"]
    lines += [f"v {x} {y} {z}" for x, y, z in vertices] + [f"vt {u} {v}" for u, v in uv]
    lines += ["f " + " ".join(f"{i}/{i}" for i in face) for face in COARSE.faces + 1]
    image, target = io.BytesIO(), io.BytesIO()
    Image.new("RGB", (8, 8), (120, 80, 40)).save(image, "PNG")
    with zipfile.ZipFile(target, "w") as packed:
        packed.writestr("table.obj", "\n".join(lines))
        packed.writestr("table.mtl", "newmtl wood\nmap_Kd wood.png\n")
        packed.writestr("wood.png", image.getvalue())
    return target.getvalue()


def points() -> bytes:
    places, faces = trimesh.sample.sample_surface(COARSE, 5000, seed=0)
    rows = np.concatenate([places, COARSE.face_normals[faces]], 1).astype("<f4")
    names = "".join(f"property float {name}\n" for name in ("x", "y", "z", "nx", "ny", "nz"))
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(rows)}\n{names}end_header\n"
    return head.encode() + rows.tobytes()


def voxels() -> bytes:
    pitch = float(np.ptp(COARSE.vertices, axis=0).max()) / 40
    grid = COARSE.voxelized(pitch).fill()
    target, matrix = io.BytesIO(), np.asarray(grid.matrix)
    corner = np.asarray(grid.transform)[:3, 3] - pitch / 2
    np.savez_compressed(target, grid=matrix, translate=corner, scale=pitch * max(matrix.shape))
    return target.getvalue()


@pytest.mark.parametrize("transport", ["REST", "gRPC"])
def test_points_and_voxels_lie_where_their_mesh_lay(served: Served, transport: str) -> None:
    server = served.url if transport == "REST" else f"grpc://{served.grpc_address}"
    with RefineClient(server) as client:
        wanted = client.validate(MESH, SILHOUETTE, CAMERA).silhouette_iou
        cloud = client.validate(points(), SILHOUETTE, CAMERA, mesh_format="ply")
        grid = client.validate(voxels(), SILHOUETTE, CAMERA, mesh_format=MeshFormat.NPZ)
    assert cloud.silhouette_iou == pytest.approx(wanted, abs=0.05)
    assert "of 5000 points" in cloud.warnings[0]
    assert grid.silhouette_iou == pytest.approx(wanted, abs=0.1)  # a voxel is wide


@pytest.mark.parametrize("transport", ["REST", "gRPC"])
def test_the_texture_of_an_archive_is_on_the_refined_mesh(
    served: Served, transport: str, tmp_path: Path
) -> None:
    server = served.url if transport == "REST" else f"grpc://{served.grpc_address}"
    with RefineClient(server) as client:
        sent = client.submit(archive(), SILHOUETTE, CAMERA, OPTIONS, mesh_format="zip")
        ended = client.wait(sent.id, timeout_s=300)
        assert ended.state is State.SUCCEEDED
        files = client.download(sent.id, tmp_path)
    scene: Any = trimesh.load_scene(files["refined.glb"])
    (geometry,) = scene.geometry.values()
    texture = geometry.visual.material.baseColorTexture
    assert texture.convert("RGB").getpixel((3, 3)) == (120, 80, 40)
    assert not any("texture" in warning for warning in ended.warnings)
