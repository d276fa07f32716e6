"""The page in a real browser, as a person uses it: from a sample to its refinement."""

from __future__ import annotations

import json
import re
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
import trimesh
from browser import chromium, visit
from playwright.sync_api import Browser, FilePayload, Page, expect
from serve_process import Served

from refine_engine import read_camera, read_mesh
from refine_engine.cameras.seen import silhouette_iou
from refine_engine.request import read_view

SAMPLES = Path(__file__).parents[2] / "examples/samples"
NEAR = 0.02  # of the 2D IoU: the two rasterise edges on their own
CAR = {"azimuth_degrees": 40.0, "elevation_degrees": 16.0, "distance": 1.5}
ROTATION = [
    [0.766, 0.0, -0.6428],
    [0.1772, 0.9613, 0.2112],
    [0.6179, -0.2756, 0.7364],
]  # azimuth 40, elevation 16


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with chromium() as browser:
        yield browser


@pytest.fixture
def page(browser: Browser, served: Served) -> Iterator[Page]:
    with visit(browser, served.url) as page:
        yield page


def choose(page: Page, sample: str) -> None:
    page.get_by_role("button", name=sample.title(), exact=True).click()
    expect(page.locator(".drop[data-kind=camera]")).to_contain_text(sample)
    expect(page.locator("#iou")).to_have_text(re.compile(r"\d\.\d{3}"))


def shown_iou(page: Page) -> float:
    return float(page.locator("#iou").inner_text())


def refine(page: Page, iterations: int, preset: str = "fast") -> str:
    """Press the button; the id that the page went to."""
    page.get_by_label("Preset").select_option(preset)
    page.get_by_label("Iterations").fill(str(iterations))
    page.get_by_role("button", name="Refine", exact=True).click()
    page.wait_for_url("**/#/refinements/*")
    return page.url.split("/")[-1]


@pytest.mark.parametrize("sample", ["chair", "airplane", "car"])
def test_a_sample_is_refined_and_seen(page: Page, rest: httpx.Client, sample: str, tmp_path: Path) -> None:
    choose(page, sample)
    before = shown_iou(page)
    refinement_id = refine(page, iterations=5)
    expect(page.locator(".state")).to_have_text("Done.")
    expect(page.get_by_role("heading", name="Before and after")).to_be_visible()
    iou = rest.get(f"/refinements/{refinement_id}").json()["silhouette_iou"]
    assert before == pytest.approx(iou["before"], abs=NEAR)
    for words in (f"{iou['after']:.3f}", "with preset fast and seed 0"):
        expect(page.locator(".words")).to_contain_text(words)
    for colours, words in (
        ("Symmetry confidence", "0.5: 3.9 %"),
        ("Displacement", "was moved"),
    ):
        page.get_by_role("radio", name=colours).check()
        expect(page.locator(".legend")).to_contain_text(words)
    with page.expect_download() as download:
        page.get_by_role("button", name="refined.glb").click()
    download.value.save_as(tmp_path / "refined.glb")
    assert read_mesh((tmp_path / "refined.glb").read_bytes(), "refined.glb").mesh.vertices.isfinite().all()


def test_before_and_after_are_two_pictures_and_the_slider_is_between(page: Page) -> None:
    choose(page, "chair")
    refine(page, iterations=5)
    expect(page.locator(".result")).to_be_visible()
    stage, split = page.locator(".stage"), page.get_by_role("slider", name=re.compile("before ends"))
    pictures = []
    for place in ("0", "50", "100"):
        split.fill(place)
        page.wait_for_timeout(300)  # two frames
        pictures.append(stage.screenshot())
    assert len(set(pictures)) == 3
    page.locator("canvas.mesh").focus()
    page.keyboard.press("ArrowLeft")
    page.wait_for_timeout(300)
    assert stage.screenshot() != pictures[-1]  # turned


@pytest.mark.parametrize("width", [320, 768, 2400])
def test_nothing_is_wider_than_the_window(page: Page, width: int) -> None:
    page.set_viewport_size({"width": width, "height": 700})
    choose(page, "chair")

    def overflow() -> int:
        return int(page.evaluate("document.documentElement.scrollWidth - innerWidth"))

    assert overflow() <= 0
    page.get_by_role("radio", name="Matrix").check()
    assert overflow() <= 0
    page.get_by_role("radio", name="Angles").check()
    refine(page, iterations=5)
    expect(page.locator(".words li")).not_to_have_count(0)
    assert overflow() <= 0
    page.get_by_role("link", name="Refinements", exact=True).click()
    expect(page.locator("tbody tr")).not_to_have_count(0)
    assert overflow() <= 0


def test_cancel_a_running_one(page: Page) -> None:
    choose(page, "chair")
    refine(page, iterations=10_000)
    expect(page.locator(".progress-words")).to_contain_text("Iteration")
    page.get_by_role("button", name="Cancel").click()
    expect(page.locator(".state")).to_have_text("It was cancelled.")
    expect(page.locator(".result")).to_be_hidden()


def test_a_wrong_camera_is_seen_before_and_told_after(page: Page) -> None:
    choose(page, "chair")
    page.get_by_role("radio", name="Matrix").check()
    page.get_by_label(re.compile("Four rows")).fill("1 0 0 0  0 1 0 0  0 0 1 -2  0 0 0 1")
    expect(page.locator("#iou")).to_have_text("0.000")
    expect(page.locator("#verdict")).to_contain_text("not where the silhouette is")
    refine(page, iterations=5)
    expect(page.locator(".state")).to_have_text("It failed.")
    expect(page.locator(".error[role=alert]")).to_contain_text("OBJECT_OUT_OF_VIEW")


def test_another_reading_of_a_matrix_is_offered(page: Page) -> None:
    choose(page, "car")
    page.get_by_role("radio", name="Matrix").check()
    rows = [[*row, 0.0] for row in ROTATION[:2]] + [[*ROTATION[2], -1.5], [0.0, 0.0, 0.0, 1.0]]
    page.get_by_label(re.compile("Four rows")).fill(json.dumps(rows))
    expect(page.locator("#better")).to_contain_text("Read as opengl, world to camera")
    page.get_by_role("button", name="Use it").click()
    expect(page.locator("#verdict")).to_contain_text(re.compile("good start|agrees"))


@pytest.mark.parametrize(
    ("kind", "name", "content", "told"),
    [
        ("mesh", "a.glb", b"glTF123", "a.glb: this mesh cannot be read: "),
        ("mesh", "a.obj", b"v 0 0 0\n", "a.obj: expected triangles, found none"),
        ("mesh", "a.step", b"ISO-10303", "expected a GLB, glTF, OBJ, PLY, STL, OFF, binvox, NPZ or ZIP file"),
        ("silhouette", "a.png", b"none", "a.png: expected a PNG, JPEG, WebP, TIFF or BMP image"),
        ("camera", "a.json", b'{"type": "spherical"}', "a.json: expected type look_at or matrix"),
    ],
)
def test_a_file_that_cannot_be_read_is_told_and_the_last_one_stays(
    page: Page, kind: str, name: str, content: bytes, told: str
) -> None:
    choose(page, "car")
    file: FilePayload = {"name": name, "mimeType": "application/octet-stream", "buffer": content}
    page.locator(f"input[name={kind}]").set_input_files(file)
    expect(page.locator("[data-error=files]")).to_contain_text(told)
    expect(page.locator(f".drop[data-kind={kind}]")).to_contain_text("car/")
    expect(page.get_by_role("button", name="Refine", exact=True)).to_be_enabled()


POINTS = b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n0\n"


@pytest.mark.parametrize(
    ("kind", "name", "content", "told"),
    [
        (
            "mesh",
            "a.zip",
            b"PK\3\4",
            "a.zip is an archive: the server reads it, but this page cannot show it",
        ),
        ("mesh", "a.npz", b"PK\3\4", "a.npz is an archive"),
        ("mesh", "a.binvox", b"#binvox 1\n", "a.binvox is a voxel grid"),
        ("mesh", "a.ply", POINTS, "a.ply is points"),
        ("silhouette", "a.tif", b"II*\0", "a.tif is a TIFF"),
    ],
)
def test_what_only_the_server_reads_can_be_submitted(
    page: Page, kind: str, name: str, content: bytes, told: str
) -> None:
    choose(page, "car")
    file: FilePayload = {"name": name, "mimeType": "application/octet-stream", "buffer": content}
    page.locator(f"input[name={kind}]").set_input_files(file)
    expect(page.locator("[data-error=files]")).to_contain_text(told)
    expect(page.locator(f".drop[data-kind={kind}]")).to_contain_text(name)
    expect(page.locator("#iou")).to_have_text("\N{EN DASH}")
    expect(page.get_by_role("button", name="Refine", exact=True)).to_be_enabled()


def test_an_archive_is_refined(page: Page, tmp_path: Path) -> None:
    choose(page, "car")
    with zipfile.ZipFile(tmp_path / "car.zip", "w") as archive:
        archive.write(SAMPLES / "car" / "coarse.obj", "coarse.obj")
    page.locator("input[name=mesh]").set_input_files(tmp_path / "car.zip")
    expect(page.locator(".drop[data-kind=mesh]")).to_contain_text("car.zip")
    refine(page, iterations=5)
    expect(page.locator(".state")).to_have_text("Done.")


def test_what_is_no_camera_is_said(page: Page) -> None:
    choose(page, "chair")
    page.get_by_role("spinbutton", name="Distance").fill("-1")
    expect(page.locator("[data-error=camera]")).to_have_text("expected a distance above 0, got -1")
    expect(page.get_by_role("button", name="Refine", exact=True)).to_be_disabled()


def matrix(convention: str, **lens: Any) -> dict[str, Any]:
    """The camera of the sample car as a matrix of a convention, nearly."""
    signs = {"opencv": (1, -1, -1), "opengl": (1, 1, 1), "pytorch3d": (-1, 1, -1)}[convention]
    rows = [[sign * x for x in row] for sign, row in zip(signs, ROTATION, strict=True)]
    depth = -1.5 * signs[2]
    whole = [[*row, depth if i == 2 else 0.0] for i, row in enumerate(rows)] + [[0.0, 0.0, 0.0, 1.0]]
    return {"type": "matrix", "convention": convention, "world_to_camera": whole, **lens}


def inverse(spec: dict[str, Any]) -> dict[str, Any]:
    """The same as camera_to_world."""
    rows = spec.pop("world_to_camera")
    turned = [[rows[j][i] for j in range(3)] for i in range(3)]
    place = [-sum(turned[i][j] * rows[j][3] for j in range(3)) for i in range(3)]
    return spec | {
        "camera_to_world": [[*row, x] for row, x in zip(turned, place, strict=True)] + [[0.0, 0.0, 0.0, 1.0]]
    }


CAMERAS: list[dict[str, Any]] = [
    {"type": "look_at", **CAR, "fov_y_degrees": 45},
    {"type": "look_at", "azimuth_degrees": -170, "elevation_degrees": -35, "distance": 1.2},
    {"type": "look_at", "azimuth_degrees": 10, "elevation_degrees": 90, "distance": 2.5, "fov_y_degrees": 30},
    matrix("opencv", fov_y_degrees=60),
    inverse(matrix("opengl", fov_y_degrees=50)),
    matrix("pytorch3d", fov_y_degrees=60),
    matrix("opencv", intrinsics={"fx": 210, "fy": 180, "cx": 130, "cy": 95}),
    inverse(
        matrix("opencv", projection="orthographic", intrinsics={"fx": 150, "fy": 130, "cx": 100, "cy": 118})
    ),
]


def test_the_2d_iou_is_the_engines_for_every_form_of_camera(page: Page) -> None:
    folder = SAMPLES / "car"
    choose(page, "car")
    mesh = read_mesh((folder / "coarse.obj").read_bytes(), "coarse.obj").mesh
    for spec in CAMERAS:
        written = json.dumps(spec)
        page.get_by_role("radio", name="Matrix").check()
        page.get_by_label(re.compile("Four rows")).fill(written)
        expected = silhouette_iou(
            mesh, read_view((folder / "silhouette.png").read_bytes(), read_camera(spec))
        )
        assert expected > 0.1, spec
        page.wait_for_function(
            "([wanted, near]) => Math.abs(document.querySelector('#iou').textContent - wanted) < near",
            arg=[expected, NEAR],
            timeout=10_000,
        )


@pytest.mark.parametrize("form", ["glb", "obj", "ply", "stl", "off"])
def test_every_format_of_a_mesh_is_read_alike(page: Page, form: str, tmp_path: Path) -> None:
    choose(page, "car")
    expected = shown_iou(page)
    coarse = trimesh.load_mesh(SAMPLES / "car" / "coarse.obj")
    file = tmp_path / f"coarse.{form}"
    coarse.export(file)
    page.locator("input[name=mesh]").set_input_files(file)
    expect(page.locator(".drop[data-kind=mesh]")).to_contain_text(file.name)
    assert shown_iou(page) == pytest.approx(expected, abs=0.005)
    expect(page.locator("[data-error=files]")).to_have_text("")
