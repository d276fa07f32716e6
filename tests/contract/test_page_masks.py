"""The page sees the mask that the engine reads: the same pixels, by the same rules, written twice."""

from __future__ import annotations

import base64
import io
import json
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image, ImageFilter

from refine_engine.errors import SilhouetteInvalid
from refine_engine.files.silhouette import read_silhouette
from refine_proto.formats import SILHOUETTE_THRESHOLD

MASK = Path(__file__).parents[2] / "service/refine_service/page/mask.js"
SCRIPT = """
const { objectOf } = await import(process.argv[1]);
let text = "";
for await (const part of process.stdin) text += part;
const seen = JSON.parse(text).map(({ width, height, data }) => {
  const bytes = Uint8ClampedArray.from(Buffer.from(data, "base64"));
  return objectOf({ width, height, data: bytes }, Number(process.argv[2]));
});
console.log(JSON.stringify(seen.map((object) => object && [...object])));
"""
DISC = np.hypot(*(np.mgrid[0:24, 0:30] - np.array([11, 13])[:, None, None])) < 7
OUTER = np.hypot(*(np.mgrid[0:24, 0:30] - np.array([11, 13])[:, None, None])) < 10


def grey(levels: Any, alpha: Any = 255) -> Image.Image:
    layers = [np.broadcast_to(layer, DISC.shape) for layer in (levels, levels, levels, alpha)]
    return Image.fromarray(np.dstack(layers).astype(np.uint8))


def coloured(inside: tuple[int, ...], outside: tuple[int, ...]) -> Image.Image:
    return Image.fromarray(np.where(DISC[..., None], inside, outside).astype(np.uint8))


def pictures() -> list[Image.Image]:
    soft = [grey(DISC * 255).convert("L").filter(ImageFilter.GaussianBlur(radius)) for radius in (1, 2, 4)]
    margin = np.full(DISC.shape, 255)
    margin[0] = 0
    chance = np.random.default_rng(0)
    photo = chance.integers(0, 256, DISC.shape)
    black, red, yellow, blue = (0, 0, 0), (255, 0, 0), (255, 255, 0), (0, 0, 255)
    return [
        grey(DISC * 255), grey(255 - DISC * 255), grey(DISC * 1), grey(DISC * 127), grey(DISC * 60 + 50),
        grey(0, DISC * 255), grey(255, DISC * 127), grey(0, 255 - DISC * 1), grey(DISC * 255, margin),
        grey(photo, margin), grey(photo, DISC * 255), coloured((128, 0, 0), black), coloured(blue, black),
        coloured(red, (0, 255, 0)), coloured(yellow, blue), coloured((255, 9, 9), (255, 0, 40)),
        coloured(black, (200, 0, 90)), grey(DISC * 80 + OUTER * 40), grey(DISC * 200 + OUTER * 20),
        *soft, *(image.point(lambda level: level // 3) for image in soft),
        *(Image.fromarray(chance.integers(0, 2, (9, 9, 4), np.uint8) * 85) for _ in range(40)),
        *(Image.fromarray(chance.integers(0, 256, (7, 8, 4), np.uint8)) for _ in range(20)),
    ]  # fmt: skip


def engines(image: Image.Image) -> list[int] | None:
    stream = io.BytesIO()
    image.save(stream, "PNG")
    try:
        return [int(x) for x in read_silhouette(stream.getvalue()).coverage.flatten()]
    except SilhouetteInvalid:
        return None


def test_it_is_the_mask_that_the_engine_reads() -> None:
    if (node := shutil.which("node")) is None:
        pytest.skip("needs node")
    images = pictures()
    sent = [
        {
            "width": image.width,
            "height": image.height,
            "data": base64.b64encode(image.convert("RGBA").tobytes()).decode(),
        }
        for image in images
    ]
    command = [node, "--input-type=module", "-e", SCRIPT, MASK.as_uri(), str(SILHOUETTE_THRESHOLD)]
    done = subprocess.run(command, input=json.dumps(sent), capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    differ = [n for n, seen in enumerate(json.loads(done.stdout)) if seen != engines(images[n])]
    assert differ == []
