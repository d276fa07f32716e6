"""Materials and textures of OBJ and PLY files: what becomes of them, and what is said of the rest."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

from refine_engine.files import gltf
from refine_engine.files.beside import in_folder_of
from refine_engine.files.mesh_file import MeshFile, read_mesh

SQUARE = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
TEXTURED = "mtllib a.mtl\n" + SQUARE + "usemtl skin\nf 1/1 2/2 3/3 4/4\n"


def image(kind: str = "PNG") -> bytes:
    target = io.BytesIO()
    Image.fromarray(np.arange(48, dtype=np.uint8).reshape(4, 4, 3)).save(target, kind)
    return target.getvalue()


def read(files: Mapping[str, str | bytes], folder: Path) -> MeshFile:
    """The first of the files, with the others beside it."""
    for name, content in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content.encode() if isinstance(content, str) else content)
    path = folder / next(iter(files))
    return read_mesh(path.read_bytes(), path.name, beside=in_folder_of(path))


def written(file: MeshFile) -> gltf.Document:
    return gltf.parse(file.with_vertices(file.mesh.vertices, torch.ones(len(file.mesh.vertices))))


def textures(document: gltf.Document, material: int = 0) -> dict[str, bytes]:
    """The images of a material by the names of its textures."""
    json = document.json["materials"][material]
    found = {}
    for name, texture in {**json, **json["pbrMetallicRoughness"]}.items():
        if name.endswith("Texture"):
            source = document.json["images"][document.json["textures"][texture["index"]]["source"]]
            view = document.json["bufferViews"][source["bufferView"]]
            found[name] = bytes(document.binary[view["byteOffset"] :][: view["byteLength"]])
    return found


def test_what_texture_bakers_write_keeps_its_texture(tmp_path: Path) -> None:
    """OBJ, MTL and PNG side by side, as TripoSR and InstantMesh leave them."""
    mtl = "newmtl skin\nKa 1 1 1\nKd 0.4 0.4 0.4\nKs 0.4 0.4 0.4\nNs 10\nillum 2\nmap_Kd texture.png\n"
    file = read({"mesh.obj": TEXTURED, "a.mtl": mtl, "texture.png": image()}, tmp_path)
    assert not file.warnings
    assert file.textured
    document = written(file)
    assert textures(document) == {"baseColorTexture": image()}
    material = document.json["materials"][0]
    assert material["name"] == "skin"
    assert material["pbrMetallicRoughness"]["baseColorFactor"] == [1, 1, 1, 1]  # the grey would darken it
    glb = file.with_vertices(file.mesh.vertices, torch.ones(4))
    scene: Any = trimesh.load_scene(io.BytesIO(glb), file_type="glb")
    seen = next(iter(scene.geometry.values())).visual.material.baseColorTexture
    assert np.array_equal(np.asarray(seen.convert("RGB")), np.arange(48).reshape(4, 4, 3))


def test_an_archive_brings_its_materials() -> None:
    target = io.BytesIO()
    with zipfile.ZipFile(target, "w") as archive:
        archive.writestr("model/mesh.obj", TEXTURED)
        archive.writestr("model/a.mtl", "newmtl skin\nmap_Kd maps/skin one.jpg\n")
        archive.writestr("model/maps/skin one.jpg", image("JPEG"))
    file = read_mesh(target.getvalue(), "mesh.zip")
    assert not file.warnings
    assert textures(written(file)) == {"baseColorTexture": image("JPEG")}


def test_values_of_materials_are_those_of_gltf(tmp_path: Path) -> None:
    mtl = "newmtl red\nKd 1 0.5 0\nd 0.5\nPr 0.3\nPm 1\nKe 0 0 1\nnewmtl blue\nKd 0 0 1\nd 0\n"
    faces = "usemtl red\nf 1 2 3\nusemtl blue\nf 1 3 4\n"
    file = read({"a.obj": "mtllib a.mtl\n" + SQUARE + faces, "a.mtl": mtl}, tmp_path)
    document = written(file)
    primitives = document.json["meshes"][0]["primitives"]
    red, blue = (document.json["materials"][primitive["material"]] for primitive in primitives)
    surface = red["pbrMetallicRoughness"]
    assert surface["baseColorFactor"] == pytest.approx([1, 0.2140, 0, 0.5], abs=1e-4)
    assert (surface["roughnessFactor"], surface["metallicFactor"]) == (0.3, 1)
    assert (red["alphaMode"], red["emissiveFactor"]) == ("BLEND", [0, 0, 1])
    assert blue["pbrMetallicRoughness"]["baseColorFactor"] == [0, 0, 1, 1]
    assert not file.warnings


@pytest.mark.parametrize(
    ("mtl", "says"),
    [
        (None, "material file 'a.mtl' is not there: put it beside the mesh, or send all in a .zip"),
        ("newmtl other\n", "1 of 1 materials are in no material file (first: 'skin')"),
        ("newmtl skin\nmap_Kd missing.png\n", "texture 'missing.png' is not there"),
        (
            "newmtl skin\nmap_Kd b.tga\n",
            "expected a texture as PNG or JPEG, got 'b.tga': left out; convert it",
        ),
        ("newmtl skin\nmap_Ks t.png\nbump -bm 1 t.png\n", "of the material files map_ks, bump were left out"),
        ("newmtl skin\nmap_Kd -s 2 2 1 t.png\n", "options of map_kd were left out"),
        ("newmtl skin\nmap_Kd ../t.png\nmap_d t.png\n", "map_d were left out"),
    ],
)
def test_what_is_lost_is_said(mtl: str | None, says: str, tmp_path: Path) -> None:
    files: dict[str, str | bytes] = {"a.obj": TEXTURED, "t.png": image(), "b.tga": b"\0\0\2"}
    if mtl is not None:
        files["a.mtl"] = mtl
    (warning,) = read(files, tmp_path).warnings
    assert says in warning


@pytest.mark.parametrize(
    "line",
    ["t.png", "-s 1 1 1 -o 0 0 t.png", "-clamp on t.png", r"C:\Users\me\t.png", "/home/me/t.png", "./t.png"],
)
def test_textures_are_found_however_they_are_named(line: str, tmp_path: Path) -> None:
    files: dict[str, str | bytes] = {
        "a.obj": TEXTURED,
        "a.mtl": f"newmtl skin\nmap_Kd {line}\n",
        "t.png": image(),
    }
    file = read(files, tmp_path)
    assert textures(written(file)) == {"baseColorTexture": image()}
    assert not file.warnings


@pytest.mark.parametrize(
    "line", ["a.mtl", "./a.mtl", r"C:\Users\me\a.mtl", "none.mtl a.mtl", "a.mtl # made by me"]
)
def test_material_files_are_found_however_they_are_named(line: str, tmp_path: Path) -> None:
    obj, mtl = TEXTURED.replace("a.mtl", line), "newmtl skin\nmap_Kd t.png\n"
    file = read({"a.obj": obj.encode(), "a.mtl": mtl.encode(), "t.png": image()}, tmp_path)
    assert textures(written(file)) == {"baseColorTexture": image()}
    assert len(file.warnings) == ("none" in line)


def test_hundreds_of_lost_files_are_one_warning(tmp_path: Path) -> None:
    names = [f"m{i}" for i in range(900)]
    mtl = "".join(f"newmtl {name}\nmap_Kd {name}.png\n" for name in names)
    lines = "".join(f"mtllib {name}.mtl\nusemtl {name}\nf 1/1 2/2 3/3\n" for name in names)
    told = read({"a.obj": "mtllib a.mtl\n" + SQUARE + lines, "a.mtl": mtl}, tmp_path).warnings
    assert [warning.partition(" is not there")[0] for warning in told] == [
        "the material file 'm0.mtl' and 899 others",
        "the texture 'm0.png' and 899 others",
    ]


def test_one_image_is_stored_once_and_materials_without_coordinates_have_none(tmp_path: Path) -> None:
    mtl = "newmtl a\nmap_Kd t.png\nmap_d t.png\nnorm t.png\nnewmtl b\nmap_Kd t.png\nmap_Ke t.png\n"
    mtl += "newmtl c\nmap_Kd t.png\n"
    faces = "usemtl a\nf 1/1 2/2 3/3\nusemtl b\nf 1/1 3/3 4/4\n"
    document = written(
        read({"a.obj": "mtllib a.mtl\n" + SQUARE + faces, "a.mtl": mtl, "t.png": image()}, tmp_path)
    )
    assert len(document.json["images"]) == 1
    assert set(textures(document, 0)) == {"baseColorTexture", "normalTexture"}
    assert document.json["materials"][0]["alphaMode"] == "MASK"
    assert set(textures(document, 1)) == {"baseColorTexture", "emissiveTexture"}
    assert document.json["materials"][1]["emissiveFactor"] == [1, 1, 1]
    bare = read({"b.obj": "mtllib a.mtl\nusemtl c\n" + SQUARE + "f 1 2 3\n"}, tmp_path)
    assert "no texture coordinates" in bare.warnings[0]
    assert "images" not in written(bare).json


def test_the_texture_that_a_ply_names(tmp_path: Path) -> None:
    ply = (
        "ply\nformat ascii 1.0\ncomment TextureFile my skin.png\nelement vertex 3\nproperty float x\n"
        "property float y\nproperty float z\nproperty float s\nproperty float t\nelement face 1\n"
        "property list uchar int vertex_indices\nend_header\n0 0 0 0 0\n1 0 0 1 0\n0 1 0 0 1\n3 0 1 2\n"
    )
    file = read({"a.ply": ply, "my skin.png": image()}, tmp_path)
    assert textures(written(file)) == {"baseColorTexture": image()}
    assert "'my skin.png' is not there" in read_mesh(ply.encode(), "a.ply").warnings[0]


def test_a_material_file_is_read_once_however_often_it_is_named(tmp_path: Path) -> None:
    asked: list[str] = []

    def beside(uri: str) -> bytes | None:
        asked.append(uri)
        return b"newmtl skin\nmap_Kd t.png\n" * 1000 if uri == "a.mtl" else image()

    text = "mtllib a.mtl\nmtllib ./a.mtl\n" * 1000 + TEXTURED
    assert read_mesh(text.encode(), "a.obj", beside=beside).textured
    assert sorted(asked) == ["a.mtl", "t.png"]
