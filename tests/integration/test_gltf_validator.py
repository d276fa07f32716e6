"""The GLBs we write pass the Khronos glTF validator (npm package gltf-validator), where node and npm are
present."""

from __future__ import annotations

import io
import json
import os
import shutil
import subprocess
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

from refine_engine.files.materials import Material
from refine_engine.files.mesh_file import read_mesh
from refine_engine.files.polygons import mesh_document

PACKAGE = "gltf-validator@2.0.0-dev.3.10"
ROOT = Path(__file__).parents[2]
CACHE = ROOT / ".cache" / "gltf-validator"
WARNING = 1  # the validator's severities: 0 error, 1 warning, 2 information
SCRIPT = """
const validator = require('gltf-validator'), fs = require('fs');
validator.validateBytes(new Uint8Array(fs.readFileSync(process.argv[1])))
  .then(report => console.log(JSON.stringify(report.issues)), error => { console.error(error);
  process.exit(1); });
"""


@pytest.fixture(scope="module")
def validator() -> Path:
    node, npm = shutil.which("node"), shutil.which("npm")
    if node is None or npm is None:
        pytest.skip("node and npm are not installed")
    if not (CACHE / "node_modules" / "gltf-validator").is_dir():
        CACHE.mkdir(parents=True, exist_ok=True)
        command = [npm, "install", "--no-save", "--no-audit", "--no-fund", "--prefix", str(CACHE), PACKAGE]
        done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
        if done.returncode:
            pytest.skip(f"npm could not install {PACKAGE} (offline?): {done.stderr[-200:]}")
    return Path(node)


def issues(node: Path, data: bytes, path: Path) -> dict[str, Any]:
    path.write_bytes(data)
    done = subprocess.run(
        [str(node), "-e", SCRIPT, str(path)],
        cwd=CACHE,
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
    )
    found: dict[str, Any] = json.loads(done.stdout)
    return found


def problem(message: dict[str, Any]) -> tuple[str, str]:
    return message["code"], message["pointer"]


def sphere(**visual: Any) -> Any:
    mesh = trimesh.creation.icosphere(2)
    return trimesh.Trimesh(mesh.vertices, mesh.faces, process=False, **visual)


def inputs() -> dict[str, bytes]:
    """Files of every format, and a glTF scene with a texture, turned nodes and a mirrored instance."""
    library: Any = trimesh
    size = len(sphere().vertices)
    paint = library.visual.material.PBRMaterial(
        baseColorTexture=Image.fromarray(np.full((4, 4, 3), 90, np.uint8))
    )
    uv = np.random.default_rng(0).random((size, 2))
    textured = sphere(visual=library.visual.TextureVisuals(uv=uv, material=paint))
    assert len(textured.vertex_normals) == size  # having computed them, trimesh exports them
    transforms = library.transformations
    scene = library.Scene()
    scene.add_geometry(textured, node_name="body", transform=transforms.rotation_matrix(0.5, [1, 2, 3]))
    scene.add_geometry(library.creation.box(), node_name="left", geom_name="wheel")
    scene.graph.update(frame_to="right", geometry="wheel", matrix=transforms.scale_matrix(-2, [3, 0, 0]))
    coloured = sphere(vertex_colors=np.random.default_rng(1).integers(0, 255, (size, 4)))
    kinds = ("obj", "ply", "stl", "off", "glb")
    exported = {f"plain.{kind}": sphere().export(file_type=kind) for kind in kinds}
    exported |= {"scene.glb": scene.export(file_type="glb"), "coloured.ply": coloured.export(file_type="ply")}
    exported |= {"tangents.glb": anisotropic(), "materials.zip": archive()}
    return {name: data.encode() if isinstance(data, str) else data for name, data in exported.items()}


def archive() -> bytes:
    """OBJ with two materials and a texture."""
    faces = "usemtl skin\nf 1/1 2/2 3/3\nusemtl glass\nf 1/1 3/3 4/1\n"
    mesh = "mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 1\nvt 0 0\nvt 1 0\nvt 1 1\n" + faces
    image, target = io.BytesIO(), io.BytesIO()
    Image.new("RGBA", (4, 4), (9, 200, 30, 128)).save(image, "PNG")
    with zipfile.ZipFile(target, "w") as packed:
        packed.writestr("a.obj", mesh)
        materials = "newmtl skin\nmap_Kd a.png\nmap_d a.png\nnewmtl glass\nKd 1 0 0\nd 0.5\nKe 1 1 0\n"
        packed.writestr("a.mtl", materials)
        packed.writestr("a.png", image.getvalue())
    return target.getvalue()


def anisotropic() -> bytes:
    """A material that needs tangents, and has no texture from which a viewer could derive them."""
    mesh = sphere()
    normals = np.asarray(mesh.vertex_normals, np.float32)
    along = np.cross(normals, [0.1, 1.0, 0.2])
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    tangents = np.concatenate([along, np.ones((len(along), 1))], 1).astype(np.float32)
    part = {"POSITION": mesh.vertices.astype(np.float32), "NORMAL": normals, "TANGENT": tangents}
    extension = "KHR_materials_anisotropy"
    material = Material({"extensions": {extension: {"anisotropyStrength": 0.5}}})
    document = mesh_document([({**part, "faces": np.asarray(mesh.faces)}, material)])
    document.json["extensionsUsed"] = [extension]
    return document.to_glb()


def samples() -> dict[str, bytes]:
    shared = Path(os.environ.get("REFINE_SHARED", ROOT.parent / "shared")) / "inputs" / "good"
    return {path.name: path.read_bytes() for path in sorted(shared.glob("*.*"))}


def test_everything_we_write_is_valid(validator: Path, tmp_path: Path) -> None:
    for name, data in (inputs() | samples()).items():
        file = read_mesh(data, name)
        size = len(file.mesh.vertices)
        generator = torch.Generator().manual_seed(0)
        extent = (file.mesh.vertices.amax(0) - file.mesh.vertices.amin(0)).max()
        moved = file.mesh.vertices + 0.02 * extent * torch.randn(size, 3, generator=generator)
        confidence = torch.rand(size, generator=generator)
        before: set[tuple[str, str]] = set()
        if data[:4] == b"glTF":  # what was wrong with the input is not ours to answer for
            before = {problem(m) for m in issues(validator, data, tmp_path / "in.glb")["messages"]}
        for kind, written in {
            "refined": file.with_vertices(moved, confidence),
            "confidence": file.confidence_glb(moved, confidence),
        }.items():
            messages = issues(validator, written, tmp_path / "out.glb")["messages"]
            bad = [m for m in messages if m["severity"] <= WARNING and problem(m) not in before]
            assert not bad, (name, kind, bad[:3])
