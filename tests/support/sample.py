"""A sample of examples/samples as a request that takes little time."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

SAMPLE = Path(__file__).parents[2] / "examples/samples/table"
MESH = SAMPLE / "coarse.obj"
SILHOUETTE = SAMPLE / "silhouette.png"
CAMERA: dict[str, Any] = json.loads((SAMPLE / "camera.json").read_text())
OPTIONS: dict[str, Any] = {"preset": "fast", "iterations": 5, "seed": 3}


def form(**changes: Any) -> dict[str, Any]:
    """The multipart form of the request, with other options: arguments of an httpx call."""
    fields = {"camera": CAMERA, "options": {**OPTIONS, **changes}}
    return {
        "data": {name: json.dumps(value) for name, value in fields.items()},
        "files": {"mesh": ("coarse.obj", MESH.read_bytes()), "silhouette": SILHOUETTE.read_bytes()},
    }
