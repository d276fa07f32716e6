"""Pictures for people: shaded renders, contours, and the confidence seen by the input camera. PIL images."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from ..cameras.seen import seen_by
from ..files.colour_scale import confidence_colours
from ..kernels import Fragments, interpolate
from ..values import Camera, Mesh, View

Picture = NDArray[np.uint8]  # (H, W, 3 or 4)
Colour = tuple[int, int, int]
PANEL_PIXELS = 320  # pixels a side
_CAPTION = 26  # pixels of height
_SAMPLES = 2  # per pixel and axis, for smooth edges
_STEEPEST = 30.0  # degrees, elevation of the camera at the side
_SIDE_FOV = 30.0  # degrees
_COMPRESSION = 3  # of PNG, zlib's levels: two thirds of the time of the usual 6, files a tenth larger
_MAX_SIDE = 1024  # pixels of confidence.png; a larger camera image is scaled down
_INPUT, _BEFORE, _AFTER = (0, 140, 51), (230, 89, 0), (26, 64, 230)
_UNKNOWN, _HATCH = (150, 150, 150), 16  # colour, and pixels from line to line
_PAPER, _SURFACE, _OBJECT, _MASK = (255, 255, 255), (168, 184, 209), (209, 209, 209), (38, 38, 38)


def draw_preview(views: Sequence[View], before: Mesh, after: Mesh, confidence: torch.Tensor) -> bytes:
    """preview.png: silhouette, mesh before and after, and their contours, as the first camera sees them;
    below, the confidence and the same meshes from the side, which the silhouette does not see; and the
    contours in all further views. Unknown pixels are hatched."""
    view = views[0]
    front = fit(view.camera, PANEL_PIXELS * _SAMPLES)
    side = side_camera(view.camera, before, PANEL_PIXELS * _SAMPLES)
    mask, unknown = _seen(view, front)
    seen = [hard_render(mesh, front) for mesh in (before, after)]
    aside = [hard_render(mesh, side) for mesh in (before, after)]
    covered = [(fragments.face[0] >= 0).numpy() for fragments in (*seen, *aside)]
    contours = [(covered[0], _BEFORE), (covered[1], _AFTER), (mask, _INPUT)]
    from_side = [(covered[2], _BEFORE), (covered[3], _AFTER)]
    sigma = confidence_picture(seen[1], after, confidence)
    rows = [
        [
            ("input silhouette", _hatched(_two_colours(mask, _MASK), unknown)),
            ("before", shade(before, front, seen[0])),
            ("after", shade(after, front, seen[1])),
            ("contours: input, before, after", _hatched(_contours(mask, contours), unknown)),
        ],
        [
            ("symmetry confidence, dark 0, bright 1", on_paper(sigma)),
            ("before, from the side", shade(before, side, aside[0])),
            ("after, from the side", shade(after, side, aside[1])),
            ("contours from the side: before, after", _contours(covered[2], from_side)),
        ],
    ]
    further = [
        (f"contours in view {number}", _contours_in(other, before, after))
        for number, other in enumerate(views[1:], 2)
    ]
    rows += [further[i : i + len(rows[0])] for i in range(0, len(further), len(rows[0]))]
    return encode(grid(rows))


def _contours_in(view: View, before: Mesh, after: Mesh) -> Picture:
    """Contours of the input and of both meshes, as a further view sees them."""
    camera = fit(view.camera, PANEL_PIXELS * _SAMPLES)
    mask, unknown = _seen(view, camera)
    covered = [(hard_render(mesh, camera).face[0] >= 0).numpy() for mesh in (before, after)]
    contours = [(covered[0], _BEFORE), (covered[1], _AFTER), (mask, _INPUT)]
    return _hatched(_contours(mask, contours), unknown)


def _seen(view: View, camera: Camera) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """The object and the unknown pixels of a view, at the size of `camera`."""
    everywhere = torch.ones_like(view.silhouette, dtype=torch.bool)
    known = everywhere if view.known is None else view.known
    masks = [mask.cpu().numpy().astype(np.float32) for mask in (view.object(), ~known)]
    return (
        _resize(masks[0], camera.width, camera.height),
        _resize(masks[1], camera.width, camera.height),
    )


def draw_confidence(view: View, mesh: Mesh, confidence: torch.Tensor) -> bytes:
    """confidence.png: the confidence on the refined mesh as the input camera sees it, pixel by pixel over the
    input image (scaled down to 1024 pixels if it is larger), background transparent, with a legend below."""
    camera = drawn_camera(view)
    picture = confidence_picture(hard_render(mesh, camera), mesh, confidence)
    words = ("0: no mirror image", "1: mirrored") if camera.width >= 200 else ("0", "1")
    return encode(np.concatenate([picture, legend(camera.width, *words)]))


def drawn_camera(view: View) -> Camera:
    """The camera of a view, its image scaled down to 1024 pixels if it is larger."""
    camera = view.camera
    return fit(camera, _MAX_SIDE) if max(camera.width, camera.height) > _MAX_SIDE else camera


def drawn_silhouette(view: View) -> NDArray[np.bool_]:
    """The silhouette (H, W) at the size of `drawn_camera`."""
    camera = drawn_camera(view)
    return _resize(view.silhouette.cpu().numpy(), camera.width, camera.height)


def hard_render(mesh: Mesh, camera: Camera) -> Fragments:
    """What the camera sees of the mesh: Fragments of one view, on the CPU."""
    return seen_by(Mesh(mesh.vertices.detach().cpu(), mesh.faces.cpu()), [camera])


def confidence_picture(fragments: Fragments, mesh: Mesh, confidence: torch.Tensor) -> Picture:
    """RGBA (H, W, 4): confidence colours on the mesh, transparent background."""
    sigma = interpolate(fragments, mesh.faces.cpu(), confidence.detach().cpu())[0].numpy()
    covered = (fragments.face[0] >= 0).numpy()
    picture = np.zeros((*covered.shape, 4), np.uint8)
    picture[covered] = 255
    picture[covered, :3] = _bytes(confidence_colours(sigma[covered]))
    return picture


def on_paper(picture: Picture) -> Picture:
    """RGB of an RGBA picture whose pixels are opaque or transparent."""
    return np.where(picture[..., 3:] > 0, picture[..., :3], np.uint8(255))


def shade(mesh: Mesh, camera: Camera, fragments: Fragments) -> Picture:
    """RGB (H, W, 3): every triangle in one shade, lit from above left of the camera, both sides alike."""
    vertices = mesh.vertices.detach().cpu() @ camera.world_to_camera[:3, :3].cpu().to(mesh.vertices.dtype).T
    a, b, c = vertices[mesh.faces.cpu()].unbind(1)
    normal = torch.nn.functional.normalize(torch.linalg.cross(b - a, c - a), dim=1)
    normal = torch.where(normal[:, 2:] > 0, -normal, normal)  # towards the camera, which looks along +Z
    light = torch.nn.functional.normalize(torch.tensor([-0.45, -0.6, -0.65]), dim=0)
    brightness = 0.25 + 0.75 * (normal @ light).clamp_min(0.0)
    colours = torch.cat([brightness[:, None] * torch.tensor(_SURFACE), torch.tensor([_PAPER])]).to(
        torch.uint8
    )
    return np.asarray(colours.numpy()[fragments.face[0].numpy()])  # background is -1: the last


def side_camera(camera: Camera, mesh: Mesh, pixels: int) -> Camera:
    """A square camera a quarter turn around the world's up axis (+Y), that sees the whole mesh, upright.

    It looks from as high as `camera` but no steeper than _STEEPEST: from above, a quarter turn shows no side.
    """
    used = mesh.vertices.detach().cpu()[mesh.faces.cpu().flatten()].double()
    centre = (used.amin(0) + used.amax(0)) / 2
    radius = float((used - centre).norm(dim=1).max())
    x, y, z = (-camera.world_to_camera[2, :3]).tolist()  # from the object towards the camera
    azimuth = math.degrees(math.atan2(x, z)) - 90.0
    elevation = math.degrees(math.atan2(y, math.hypot(x, z)))
    elevation = max(-_STEEPEST, min(_STEEPEST, elevation))
    distance = 1.15 * radius / math.sin(math.radians(_SIDE_FOV / 2))
    side = Camera.look_at(azimuth, elevation, distance, _SIDE_FOV, pixels, pixels)
    matrix = side.world_to_camera.double()
    matrix[:3, 3] -= matrix[:3, :3] @ centre
    return replace(side, world_to_camera=matrix.float())


def encode(picture: Picture) -> bytes:
    """PNG bytes of a picture."""
    stream = io.BytesIO()
    Image.fromarray(picture).save(stream, "PNG", compress_level=_COMPRESSION)
    return stream.getvalue()


def fit(camera: Camera, pixels: int) -> Camera:
    """The same camera with an image whose longest side is `pixels`."""
    scale = pixels / max(camera.width, camera.height)
    width, height = max(1, round(camera.width * scale)), max(1, round(camera.height * scale))
    across, down = width / camera.width, height / camera.height
    return replace(
        camera,
        fx=camera.fx * across,
        fy=camera.fy * down,
        cx=camera.cx * across,
        cy=camera.cy * down,
        width=width,
        height=height,
    )


def _bytes(colours: NDArray[np.floating[Any]]) -> Picture:
    """Of colours in [0, 1]."""
    return (colours * 255 + 0.5).astype(np.uint8)


def _resize(mask: NDArray[np.float32], width: int, height: int) -> NDArray[np.bool_]:
    image = Image.fromarray(_bytes(mask)).resize((width, height), Image.Resampling.BILINEAR)
    return np.asarray(image) > 127


def _two_colours(mask: NDArray[np.bool_], colour: Colour) -> Picture:
    """`colour` on the mask, paper around it."""
    return np.array([_PAPER, colour], np.uint8)[mask.astype(np.uint8)]


def _hatched(picture: Picture, mask: NDArray[np.bool_]) -> Picture:
    """The picture with diagonal lines on the mask."""
    row, column = np.indices(mask.shape)
    lines = mask & ((row + column) % _HATCH < _HATCH // 4)
    return np.where(lines[..., None], np.array(_UNKNOWN, np.uint8), picture)


def _contours(fill: NDArray[np.bool_], outlines: list[tuple[NDArray[np.bool_], Colour]]) -> Picture:
    picture = _two_colours(fill, _OBJECT)
    for mask, colour in outlines:
        picture[_outline(mask, 2)] = colour
    return picture


def _outline(mask: NDArray[np.bool_], width: int) -> NDArray[np.bool_]:
    """Pixels of the mask within `width` pixels of its border; the image's border is no border of the
    object."""
    inner = np.pad(mask, 1, mode="edge")
    for _ in range(width):
        core = inner[1:-1, 1:-1] & inner[:-2, 1:-1] & inner[2:, 1:-1] & inner[1:-1, :-2] & inner[1:-1, 2:]
        inner = np.pad(core, 1, mode="edge")
    return mask & ~inner[1:-1, 1:-1]


def grid(rows: list[list[tuple[str, Picture]]]) -> Picture:
    """Panels with captions, four to a row; each picture is scaled into its panel with its aspect kept."""
    sheet = Image.new("RGB", (PANEL_PIXELS * len(rows[0]), (PANEL_PIXELS + _CAPTION) * len(rows)), "white")
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(15)
    for down, row in enumerate(rows):
        for across, (caption, picture) in enumerate(row):
            left, top = across * PANEL_PIXELS, down * (PANEL_PIXELS + _CAPTION)
            image = Image.fromarray(picture)
            image.thumbnail((PANEL_PIXELS - 4, PANEL_PIXELS - 4), Image.Resampling.BOX)
            corner = (
                left + (PANEL_PIXELS - image.width) // 2,
                top + _CAPTION + (PANEL_PIXELS - image.height) // 2,
            )
            sheet.paste(image, corner)
            draw.rectangle(
                (corner[0] - 1, corner[1] - 1, corner[0] + image.width, corner[1] + image.height),
                outline="#bbb",
            )
            _write_caption(draw, font, (left + 6, top + 4), caption)
    return np.asarray(sheet)


def _write_caption(
    draw: ImageDraw.ImageDraw,
    font: ImageFont.FreeTypeFont | ImageFont.ImageFont,
    at: tuple[int, int],
    text: str,
) -> None:
    """The words input, before and after of a contour caption stand in the colour of their contour."""
    colours = {"input": _INPUT, "before": _BEFORE, "after": _AFTER} if text.startswith("contours") else {}
    x = float(at[0])
    for word in text.split():
        draw.text((x, at[1]), word, fill=colours.get(word.strip(","), (0, 0, 0)), font=font)
        x += draw.textlength(word + " ", font=font)


def legend(width: int, low: str, high: str) -> Picture:
    """RGBA strip (40, width, 4): the colours from 0 to 1, and words for its ends."""
    strip = np.full((40, width, 4), 255, np.uint8)
    strip[6:18, 8 : max(width - 8, 9), :3] = _bytes(confidence_colours(np.linspace(0, 1, max(width - 16, 1))))
    image = Image.fromarray(strip, "RGBA")
    draw, font = ImageDraw.Draw(image), ImageFont.load_default(12)
    draw.text((8, 21), low, fill="black", font=font)
    draw.text((width - 8, 21), high, fill="black", font=font, anchor="ra")
    return np.asarray(image)
