"""GLBs with Draco-compressed primitives: what DracoPy, Google's own code, encodes is read, under limits."""

from __future__ import annotations

import random
from typing import Any

import DracoPy
import numpy as np
import pytest
import torch

from refine_engine.errors import FormatUnsupported, InputError, MeshInvalid
from refine_engine.files import gltf
from refine_engine.files.mesh_file import MeshLimits, read_mesh

EXTENSION = "KHR_draco_mesh_compression"
KINDS = {0: "POSITION", 1: "NORMAL", 3: "TEXCOORD_0"}  # by Draco's numbers


def encoded(tools: Any, **options: Any) -> bytes:
    uv = np.tile([[0.0, 0], [1, 0], [1, 1], [0, 1]], (6, 1))
    data: bytes = DracoPy.encode(
        tools.split, tools.split_faces.astype(np.uint32), 14, tex_coord=uv,
        normals=tools.normals.astype(np.float64), **options,
    )  # fmt: skip
    return data


def compressed(tools: Any, data: bytes | None = None, **options: Any) -> Any:
    """A GLB writer with the cube, its corners and normals apart, in Draco data."""
    data = data or encoded(tools, **options)
    mesh = DracoPy.decode(encoded(tools, **options))
    glb = tools.Glb()
    attributes, ids = {}, {}
    for entry in mesh.attributes:
        name = KINDS[entry["attribute_type"]]
        ids[name] = entry["unique_id"]
        shape = {"count": len(entry["data"]), "type": f"VEC{entry['num_components']}"}
        glb.json["accessors"].append({"componentType": 5126, **shape})
        attributes[name] = len(glb.json["accessors"]) - 1
    glb.json["accessors"].append({"componentType": 5123, "count": mesh.faces.size, "type": "SCALAR"})
    primitive = {
        "attributes": attributes,
        "indices": len(glb.json["accessors"]) - 1,
        "extensions": {EXTENSION: {"bufferView": glb.view(data), "attributes": ids}},
    }
    glb.json |= {
        "meshes": [{"primitives": [primitive]}],
        "extensionsUsed": [EXTENSION],
        "extensionsRequired": [EXTENSION],
    }
    return glb


@pytest.mark.parametrize("options", [{}, {"compression_level": 10}, {"preserve_order": True}])
def test_the_compressed_cube_is_the_cube(tools: Any, options: dict[str, Any]) -> None:
    file = read_mesh(compressed(tools, **options).build(), "a.glb")
    assert (len(file.mesh.vertices), len(file.mesh.faces), file.textured) == (8, 12, True)
    assert torch.cdist(file.mesh.vertices, torch.from_numpy(tools.cube)).min(0).values.max() < 1e-3
    written = file.with_vertices(file.mesh.vertices, torch.ones(8))
    document = gltf.parse(written)
    assert EXTENSION not in str(document.json)
    assert "extensionsUsed" not in document.json
    again = read_mesh(written, "a.glb")
    assert torch.equal(again.mesh.faces, file.mesh.faces)
    primitive = document.json["meshes"][0]["primitives"][0]
    normals = document.read(primitive["attributes"]["NORMAL"])
    np.testing.assert_allclose(np.abs(normals).max(1), 1, atol=1e-3)  # the edges are still hard


def test_a_plain_copy_of_the_data_is_preferred(tools: Any) -> None:
    glb = compressed(tools)
    glb.json["meshes"][0]["primitives"][0] |= {
        "attributes": {"POSITION": glb.add(tools.cube * 2)},
        "indices": glb.add(tools.cube_faces.ravel(), "u2"),
    }
    assert read_mesh(glb.build(), "a.glb").mesh.vertices.max() == 2


def test_two_primitives_may_share_the_data(tools: Any) -> None:
    glb = compressed(tools)
    glb.json["meshes"][0]["primitives"] *= 2
    assert len(read_mesh(glb.build(), "a.glb").mesh.vertices) == 8


@pytest.mark.parametrize(
    ("change", "error", "says"),
    [
        (lambda d: b"", MeshInvalid, "expected a header"),
        (lambda d: b"DRECO" + d[5:], MeshInvalid, "expected a header"),
        (lambda d: d[:5] + b"\1\3" + d[7:], FormatUnsupported, r"Draco 2\.2, .* got 1\.3"),
        (lambda d: d[:7] + b"\0" + d[8:], FormatUnsupported, "Draco mesh without metadata"),
        (lambda d: d[:9] + b"\0\x80" + d[11:], FormatUnsupported, "without metadata"),
        (lambda d: d[:12] + b"\xff\xff\xff\xff\x07\x0c" + d[14:], MeshInvalid, "at most 3000000 vertices"),
        (lambda d: d[:13] + b"\xff\xff\xff\xff\x07" + d[14:], MeshInvalid, "at most 2000000 triangles"),
        (lambda d: d[:13] + b"\xff\xff\xff\xff\xff\x07", MeshInvalid, "its header is cut off"),
        (lambda d: d[:40], MeshInvalid, "damaged Draco data"),
    ],
)
def test_refused_before_or_while_it_is_decoded(
    tools: Any, change: Any, error: type[InputError], says: str
) -> None:
    data = change(encoded(tools))
    glb = compressed(tools, data or b"nothing")
    with pytest.raises(error, match=says):
        read_mesh(glb.build(), "a.glb")


def test_the_limits_count_all_primitives(tools: Any) -> None:
    glb = compressed(tools)
    (primitive,) = glb.json["meshes"][0]["primitives"]
    again = {**primitive["extensions"][EXTENSION], "bufferView": glb.view(encoded(tools))}
    glb.json["meshes"][0]["primitives"].append({**primitive, "extensions": {EXTENSION: again}})
    with pytest.raises(MeshInvalid, match="at most 20 triangles, got 24"):
        read_mesh(glb.build(), "a.glb", MeshLimits(max_faces=20))


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda p: p["extensions"][EXTENSION]["attributes"].update(POSITION=99), "no attribute 99"),
        (lambda p: p["extensions"][EXTENSION]["attributes"].update(COLOR_0=0), "not in the primitive"),
        (lambda p: p.pop("indices"), "expected indices"),
        (lambda p: p["extensions"][EXTENSION].update(bufferView=99), "bufferViews"),
        (lambda p: p["extensions"].update({EXTENSION: []}), "malformed"),
    ],
)
def test_documents_that_contradict_their_data(tools: Any, change: Any, says: str) -> None:
    glb = compressed(tools)
    change(glb.json["meshes"][0]["primitives"][0])
    with pytest.raises(MeshInvalid, match=says):
        read_mesh(glb.build(), "a.glb")


def test_changed_bytes_are_refused_or_read(tools: Any) -> None:
    chance, good = random.Random(0), encoded(tools)
    for _ in range(2000):
        data = bytearray(good)
        for _ in range(chance.randint(1, 4)):
            data[chance.randrange(len(data))] = chance.randrange(256)
        try:
            file = read_mesh(compressed(tools, bytes(data)).build(), "a.glb")
        except (MeshInvalid, FormatUnsupported):
            continue
        file.with_vertices(file.mesh.vertices, torch.ones(len(file.mesh.vertices)))
