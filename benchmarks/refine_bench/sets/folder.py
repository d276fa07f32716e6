"""Any cases of your own, one folder each:

ROOT/<case>/coarse.obj      or any other suffix that the engine reads
ROOT/<case>/silhouette.png
ROOT/<case>/camera.json     a camera of docs/conventions.md
ROOT/<case>/gt.obj          optional: without it only the 2D IoU is measured
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

from refine_engine.cameras.spec import read_camera
from refine_engine.request import read_view
from refine_proto.formats import MESH_SUFFIXES

from ..cases import (
    Case,
    CaseUnavailable,
    Scene,
    SetInvalid,
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
    return [Case(folder.name, CATEGORY, partial(_load, folder)) for folder in folders]


def _load(folder: Path) -> Scene:
    camera = read_camera(read_bytes(folder / "camera.json"))
    view = read_view(read_bytes(folder / "silhouette.png"), camera)
    coarse, ground_truth = _mesh(folder, "coarse"), _mesh(folder, "gt")
    if coarse is None:
        raise CaseUnavailable(f"expected {folder / 'coarse.obj'} (or {', '.join(MESH_SUFFIXES)}), got none")
    return Scene(
        read_mesh_file(coarse),
        view,
        read_mesh_file(ground_truth) if ground_truth else None,
    )


def _mesh(folder: Path, stem: str) -> Path | None:
    return next((path for suffix in MESH_SUFFIXES if (path := folder / (stem + suffix)).is_file()), None)
