"""A case: one refinement with a known answer, whatever set it comes from."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import trimesh
from numpy.typing import NDArray

from refine_engine.errors import RefineError
from refine_engine.files.mesh_file import read_mesh
from refine_engine.scores.scores import SurfacePoints
from refine_engine.values import Mesh, View

from .upstream.network import Kind

Direction = tuple[float, float, float]
Truth = Mesh | SurfacePoints


class SetInvalid(RefineError):
    """A data set is not where it was said to be, or is not laid out as published; the run cannot start."""

    reason = "SET_INVALID"


class CaseUnavailable(RefineError):
    """One case lacks a file; the run goes on with the others."""

    reason = "CASE_UNAVAILABLE"


class CaseSkipped(RefineError):
    """One case does not belong to the part of the set that was asked for."""

    reason = "CASE_SKIPPED"


@dataclass(frozen=True)
class Scene:
    """What a method gets, and the truth that it does not get. All in one world frame."""

    coarse: Mesh
    view: View
    ground_truth: Truth | None
    image: NDArray[np.uint8] | None = None  # (H, W, 3), where the set has one; what the network saw
    network: Kind | None = None  # of ours, which made the coarse mesh


@dataclass(frozen=True)
class Plane:
    """A mirror plane, world frame: normal . x = offset, where its place is known."""

    normal: Direction
    offset: float | None = None


@dataclass(frozen=True)
class Case:
    """One refinement. Files are read when it is its turn: `load` raises an InputError or CaseUnavailable when
    one is missing or broken."""

    name: str  # unique in its set, and fit to be a file name
    category: str
    load: Callable[[], Scene]
    level: str = ""  # of the domain shift, where the set has levels
    asymmetric: bool = False
    plane: Plane | None = None  # of the true object; of an asymmetric one, where it is nearly symmetric
    plane_told: bool = False  # a method hears of the plane's direction; its place it finds itself


def mesh_of(shape: trimesh.Trimesh) -> Mesh:
    """float32 vertices and int64 faces."""
    return Mesh(
        torch.from_numpy(np.array(shape.vertices, np.float32)),
        torch.from_numpy(np.array(shape.faces, np.int64)),
    )


def read_mesh_file(path: Path) -> Mesh:
    """Raises CaseUnavailable without the file, an InputError when it is no mesh."""
    return read_mesh(read_bytes(path), path.name).mesh


def read_bytes(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise CaseUnavailable(f"expected {path}, got none ({error.strerror})") from error


def existing_folder(path: Path, what: str) -> Path:
    """The folder; SetInvalid when it is not there."""
    if not path.is_dir():
        found = next(parent for parent in path.absolute().parents if parent.is_dir())
        raise SetInvalid(f"expected {what} in the folder {path}, which does not exist; {found} does")
    return path


def subfolders(path: Path) -> list[Path]:
    """Sorted by name; the order of a directory is no order."""
    return sorted(child for child in path.iterdir() if child.is_dir())
