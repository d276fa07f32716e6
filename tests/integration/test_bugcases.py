"""Every file that people's reports were made of gets the right value or the right word from the command line.

They lie in `bugcases` of the shared folder; without it these tests skip. `test_check_command.py` holds the
codes of the findings and the cameras that are offered instead.
"""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest
import torch

from refine_engine.commands.check import check_command
from refine_engine.files import gltf
from refine_engine.files.beside import in_folder_of
from refine_engine.files.mesh_file import read_mesh
from refine_engine.files.silhouette import read_silhouette

BUGCASES = Path(os.environ.get("REFINE_SHARED", Path(__file__).parents[3] / "shared")) / "bugcases"
pytestmark = pytest.mark.skipif(not BUGCASES.is_dir(), reason="the shared reports are not here")
DEFAULT = ("01-wrong-camera-silent/sil.png", "01-wrong-camera-silent/true.json")

# Number of the folder, mesh, silhouette, camera; exit status of `refine check`, words of what it says.
# No words: nothing is said.
ALONE = "expected a coarse mesh with a 2D IoU of at least 0.4"  # an object that is not the one in the picture
CASES = [
    ("01", "mesh.ply", "sil.png", "true.json", 0, []),
    ("01", "mesh.ply", "sil.png", "azimuth_negated.json", 0, ["azimuth negated"]),
    ("01", "mesh.ply", "sil.png", "azimuth_plus_90.json", 0, ["azimuth -90"]),
    ("01", "mesh.ply", "sil.png", "elevation_negated.json", 0, ["elevation negated"]),
    ("01", "mesh.ply", "sil.png", "blender_z_up_camera.json", 0, ["a world with Z up"]),
    ("01", "mesh.ply", "sil.png", "pytorch3d_R_not_transposed.json", 0, ["transposed"]),
    ("02", "mesh.ply", "black_on_white.png", "camera.json", 2, ["invert it"]),
    ("02", "mesh.ply", "inpainting_style_alpha.png", "camera.json", 2, ["invert it"]),
    ("02", "mesh.ply", "photo_on_white.png", "camera.json", 2, ["invert it"]),
    ("03", "mesh.ply", "sil.png", "camera.json", 0, []),
    ("03", "mesh_mm.ply", "sil.png", "camera.json", 2, ["lengths times 1000"]),
    ("03", "mesh.ply", "sil.png", "intrinsics_of_half_size.json", 2, ["128x128"]),
    ("03", "mesh.ply", "sil.png", "normalised_intrinsics.json", 2, ["divided by"]),
    ("04", "poly_obj_concave.obj", *DEFAULT, 0, [ALONE]),
    ("04", "poly_off_concave.off", *DEFAULT, 0, [ALONE]),
    ("04", "poly_ply_concave.ply", *DEFAULT, 0, [ALONE]),
    ("04", "trimesh-wallhole.obj", *DEFAULT, 0, [ALONE, "material file '00.mtl' is not there"]),
    ("05", "0-based.obj", *DEFAULT, 2, ["face indices from 1, got 0: OBJ counts from 1"]),
    ("05", "bom.obj", *DEFAULT, 0, [ALONE]),
    ("05", "leading_spaces.obj", *DEFAULT, 0, [ALONE]),
    ("05", "tab_after_f_only.obj", *DEFAULT, 0, [ALONE]),
    ("05", "tab_after_v_only.obj", *DEFAULT, 0, [ALONE]),
    ("05", "tabs.obj", *DEFAULT, 0, [ALONE]),
    ("05", "trailing_comment_on_f.obj", *DEFAULT, 0, [ALONE]),
    ("06", "poly_obj_mtl_groups.obj", *DEFAULT, 0, [ALONE, "material file"]),
    ("06", "poly_obj_vt+colour.obj", *DEFAULT, 0, [ALONE]),
    ("06", "poly_obj_vt_only_on_some.obj", *DEFAULT, 0, [ALONE, "12 of 24"]),
    ("06", "poly_off_coff.off", *DEFAULT, 0, [ALONE]),
    ("06", "poly_off_face_colour.off", *DEFAULT, 0, [ALONE]),
    ("06", "poly_ply_diffuse_red.ply", *DEFAULT, 0, [ALONE]),
    ("06", "poly_ply_face_colour.ply", *DEFAULT, 0, [ALONE]),
    ("06", "poly_ply_uv_s_t_+_colour.ply", *DEFAULT, 0, [ALONE]),
    ("07", "mesh.ply", "L16_with_0..255.png", "camera.json", 0, ["2D IoU of 0.46"]),
    ("07", "mesh.ply", "L_0-1_mask.png", "camera.json", 0, ["2D IoU of 0.46"]),
    ("07", "mesh.ply", "P_VOC_black-maroon_128_0_0_.png", "camera.json", 0, ["2D IoU of 0.46"]),
    ("07", "mesh.ply", "P_no_palette_entries_grey0-1.png", "camera.json", 0, ["2D IoU of 0.46"]),
    ("07", "mesh.ply", "RGB_blue.png", "camera.json", 0, ["2D IoU of 0.46"]),
    ("08", "mesh.ply", "img_RGBA_alpha254_one_px.png", "camera.json", 0, ["2D IoU of 0.46"]),
    ("08", "mesh.ply", "img_RGBA_mask_with_transparent_margin_row.png", "camera.json", 0,
     ["2D IoU of 0.46", "alpha leaves out only 1.6%"]),
    ("09", "mesh.ply", "sil.png", "K_3x3.json", 0, []),
    ("09", "mesh.ply", "sil.png", "rt_3x4.json", 0, []),
    ("09", "mesh.ply", "sil.png", "fov_x.json", 0, []),
    ("09", "mesh.ply", "sil.png", "nerf_transforms.json", 0, []),
    ("09", "mesh.ply", "sil.png", "blender_scaled_camera.json", 2, ["camera_to_world", "a scale"]),
    ("10", "cube/01_cube.gltf", *DEFAULT, 0, [ALONE]),
    ("12", "fragment_at_3.ply", "sil.png", "camera.json", 0, []),
    ("12", "fragment_at_8.ply", "sil.png", "camera.json", 0, []),
    ("12", "fragment_at_30.ply", "sil.png", "camera.json", 0, []),
    ("14", "KHR_node_visibility_false.glb", *DEFAULT, 0, [ALONE, "1 nodes that are invisible"]),
    ("14", "flat_node_scale_z_0.glb", *DEFAULT, 0, [ALONE, "1 nodes that are invisible or"]),
    ("14", "hidden_node_scale_0.glb", *DEFAULT, 0, [ALONE, "1 nodes that are invisible or"]),
    ("15", "mesh.ply", "sil_sharp.png", "camera.json", 0, []),
    ("15", "mesh.ply", "sil_soft.png", "camera.json", 0, []),
    ("16", "mesh.ply", "sil_occluded.png", "camera.json", 0, []),
    ("16", "mesh.ply", "sil_sharp.png", "camera.json", 0, []),
]  # fmt: skip
AREAS = {  # of the triangles
    "04-concave-polygons/poly_obj_concave.obj": 7, "04-concave-polygons/poly_off_concave.off": 7,
    "04-concave-polygons/poly_ply_concave.ply": 7, "05-obj-dialects/bom.obj": 6,
    "05-obj-dialects/leading_spaces.obj": 6, "05-obj-dialects/tab_after_f_only.obj": 6,
    "05-obj-dialects/tab_after_v_only.obj": 6, "05-obj-dialects/tabs.obj": 6,
    "05-obj-dialects/trailing_comment_on_f.obj": 6, "10-gltf-with-bin/cube/01_cube.gltf": 24,
}  # fmt: skip
KEPT = {  # vertex attributes of refined.glb
    "poly_obj_vt+colour.obj": {"TEXCOORD_0", "COLOR_0"}, "poly_obj_vt_only_on_some.obj": {"TEXCOORD_0"},
    "poly_off_coff.off": {"COLOR_0"}, "poly_off_face_colour.off": {"COLOR_0"},
    "poly_ply_diffuse_red.ply": {"COLOR_0"}, "poly_ply_face_colour.ply": {"COLOR_0"},
    "poly_ply_uv_s_t_+_colour.ply": {"TEXCOORD_0", "COLOR_0"},
}  # fmt: skip


def place(folder: str, name: str) -> Path:
    """A file of the folder with this number, or of another one if its name says which."""
    return BUGCASES / name if name in DEFAULT else next(BUGCASES.glob(f"{folder}-*")) / name


@pytest.mark.parametrize(("folder", "mesh", "silhouette", "camera", "status", "words"), CASES)
def test_the_right_word(
    folder: str,
    mesh: str,
    silhouette: str,
    camera: str,
    status: int,
    words: list[str],
    capsys: pytest.CaptureFixture[str],
) -> None:
    files = [str(place(folder, name)) for name in (mesh, silhouette, camera)]
    assert check_command([*files[:2], "--camera", files[2], "--json"]) == status
    out, err = capsys.readouterr()
    said = [*json.loads(out)["warnings"]] if out else [err]
    assert [word for word in words if not any(word in line for line in said)] == []
    assert words or not said


@pytest.mark.parametrize(("name", "area"), AREAS.items())
def test_the_right_triangles(name: str, area: float) -> None:
    path = BUGCASES / name
    mesh = read_mesh(path.read_bytes(), path.name, beside=in_folder_of(path)).mesh
    a, b, c = mesh.vertices[mesh.faces].unbind(1)
    assert float((b - a).cross(c - a, dim=1).norm(dim=1).sum() / 2) == pytest.approx(area)


@pytest.mark.parametrize(("name", "kept"), KEPT.items())
def test_colours_and_texture_coordinates_are_kept(name: str, kept: set[str]) -> None:
    path = BUGCASES / "06-colours-and-textures-lost-silently" / name
    file = read_mesh(path.read_bytes(), path.name)
    document = gltf.parse(file.with_vertices(file.mesh.vertices, torch.ones(len(file.mesh.vertices))))
    (primitive,) = document.json["meshes"][0]["primitives"]
    assert primitive["attributes"].keys() & {"TEXCOORD_0", "COLOR_0"} == kept


def test_masks_cover_what_they_show() -> None:
    """All of 07 and 08 are one drawing; a soft edge does not make the object larger."""
    masks = [*sorted(BUGCASES.glob("07-*/*.png")), *sorted(BUGCASES.glob("08-*/*.png"))]
    covered = [read_silhouette(path.read_bytes()).coverage for path in masks]
    assert [
        path.name for path, one in zip(masks, covered, strict=True) if not torch.equal(one, covered[0])
    ] == []
    soft, sharp = (
        read_silhouette((BUGCASES / "15-soft-edges" / f"sil_{kind}.png").read_bytes()).coverage
        for kind in ("soft", "sharp")
    )
    assert float(soft.sum() / sharp.sum()) == pytest.approx(1, abs=0.02)


def test_a_stray_fragment_does_not_set_the_size() -> None:
    for distance in (3, 8, 30):
        path = BUGCASES / "12-stray-fragment" / f"fragment_at_{distance}.ply"
        low, high = read_mesh(path.read_bytes(), path.name).mesh.box()
        assert float((high - low).max()) < 4.5


def test_no_file_is_left_out() -> None:
    tried = {place(folder, name) for folder, *names, _, _ in CASES for name in names}
    beside = {"README.md", "01_cube.bin", "truth.ply"}
    here = {path for path in BUGCASES.rglob("*") if path.is_file() and path.name not in beside}
    assert sorted(here - tried) == []
