"""Any cases of your own, one folder each:

ROOT/<case>/coarse.obj      or any other suffix that the engine reads
ROOT/<case>/silhouette.png
ROOT/<case>/camera.json     a camera of docs/conventions.md
ROOT/<case>/gt.obj          optional: the true mesh; without truth only the 2D IoU is measured
ROOT/<case>/gt.xyz          instead of gt.obj: points of the true surface, three numbers a line
ROOT/<case>/symmetry.json   optional: the mirror plane of the truth, {"normal": [x, y, z], "offset": d}, and
                            "asymmetric": true where the object is not symmetric
"""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from refine_engine.cameras.spec import read_camera
from refine_engine.request import read_view
from refine_engine.scores.scores import SurfacePoints
from refine_proto.formats import MESH_SUFFIXES

from ..cases import (
    Case,
    CaseUnavailable,
    Plane,
    Scene,
    SetInvalid,
    Truth,
    existing_folder,
    read_bytes,
    read_mesh_file,
    subfolders,
)

CATEGORY = "all"  # nothing in the layout says more


def folder_cases(root: Path) -> list[Case]:
    """One case per folder that holds a camera.json; raises SetInvalid when there is none."""
    existing_folder(root, "cases")
    folders = [folder for folder in subfolders(root) if (folder / "camera.json").is_file()]
    if not folders:
        raise SetInvalid(
            f"expected folders with coarse.obj, silhouette.png and camera.json in {root}, got none"
        )
    return [
        Case(folder.name, CATEGORY, partial(_load, folder), asymmetric=asymmetric, plane=plane)
        for folder in folders
        for plane, asymmetric in [_symmetry(folder / "symmetry.json")]
    ]


def _load(folder: Path) -> Scene:
    camera = read_camera(read_bytes(folder / "camera.json"))
    view = read_view(read_bytes(folder / "silhouette.png"), camera)
    coarse, true_mesh, points = _mesh(folder, "coarse"), _mesh(folder, "gt"), folder / "gt.xyz"
    if coarse is None:
        raise CaseUnavailable(f"expected {folder / 'coarse.obj'} (or {', '.join(MESH_SUFFIXES)}), got none")
    truth: Truth | None = read_mesh_file(true_mesh) if true_mesh else None
    if truth is None and points.is_file():
        truth = SurfacePoints(_points(points))
    return Scene(read_mesh_file(coarse), view, truth, _image(folder / "image.png"))


def _points(path: Path) -> Tensor:
    """(P, 3); CaseUnavailable when the lines are not three numbers each."""
    try:
        rows = np.loadtxt(path, dtype=np.float32, ndmin=2)
    except ValueError as error:
        raise CaseUnavailable(
            f"expected three numbers a line in {path}, got something else ({error})"
        ) from error
    return torch.from_numpy(rows)


def _symmetry(path: Path) -> tuple[Plane | None, bool]:
    """The plane, and whether the object is asymmetric; SetInvalid when the file holds no plane."""
    if not path.is_file():
        return None, False
    try:
        stored = json.loads(path.read_bytes())
        x, y, z = (float(value) for value in stored["normal"])
        offset = stored.get("offset")
        plane = Plane((x, y, z), None if offset is None else float(offset))
        return plane, bool(stored.get("asymmetric", False))
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise SetInvalid(f'expected {{"normal": [x, y, z], "offset": d}} in {path} ({error!r})') from error


def _image(path: Path) -> NDArray[np.uint8] | None:
    if not path.is_file():
        return None
    with Image.open(path) as image:
        return np.array(image.convert("RGB"))


def _mesh(folder: Path, stem: str) -> Path | None:
    return next((path for suffix in MESH_SUFFIXES if (path := folder / (stem + suffix)).is_file()), None)
