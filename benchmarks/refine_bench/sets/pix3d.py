"""Pix3D: photographs with masks and aligned models.

    ROOT/pix3d.json                     a list of records
    ROOT/img/<category>/<number>.png    not needed
    ROOT/mask/<category>/<number>.png
    ROOT/model/<category>/.../model.obj

The camera that drew the masks is at the origin of the axes +X left, +Y up, +Z forward; `rot_mat` and
`trans_mat` put the model before it, `focal_length` is in mm on a sensor 32 mm wide. `cam_position` and
`inplane_rotation` describe a camera that looks at the object's centre: the same image up to a homography,
so not the mask's own pixels. Source: the README of xingyuansun/pix3d.

Models face away from +Z with their left at +X: the symmetry plane is x = 0.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path, PurePosixPath

import torch

from refine_engine.files.silhouette import read_silhouette
from refine_engine.values import Camera, View

from ..cases import (
    Case,
    CaseUnavailable,
    Plane,
    Scene,
    SetInvalid,
    existing_folder,
    read_bytes,
    read_mesh_file,
)
from ..coarse_files import CoarseFolder

SENSOR_WIDTH_MM = 32.0
HIDDEN = ("truncated", "occluded", "slightly_occluded")  # left out, as in the published evaluation
FIELDS = ("img", "category", "img_size", "mask", "model", "rot_mat", "trans_mat", "focal_length")
SYMMETRY_NORMAL = (1.0, 0.0, 0.0)


@dataclass(frozen=True)
class Pix3D:
    """Where the set lies, and which part of it is asked for."""

    root: Path
    coarse: CoarseFolder
    categories: Collection[str] = ()
    """Empty: all nine."""

    def cases(self) -> list[Case]:
        """One case per image that shows the whole object; raises SetInvalid without a pix3d.json."""
        existing_folder(self.root, "Pix3D")
        existing_folder(self.coarse.folder, "the coarse meshes")
        path = self.root / "pix3d.json"
        try:
            records = json.loads(path.read_bytes())
        except OSError as error:
            raise SetInvalid(
                f"expected {path}, got none ({error.strerror}); is {self.root} Pix3D's top folder?"
            ) from error
        except ValueError as error:
            raise SetInvalid(
                f"expected JSON in {path}, got something else ({error}); a partial download?"
            ) from error
        if not isinstance(records, list) or not all(isinstance(record, dict) for record in records):
            raise SetInvalid(f"expected a list of records in {path}, got {type(records).__name__}")
        for number, record in enumerate(records):
            if missing := [name for name in FIELDS if name not in record]:
                raise SetInvalid(
                    f"expected {', '.join(missing)} in record {number} of {path}, got {', '.join(record)}"
                )
        known = sorted({str(record["category"]) for record in records})
        if unknown := sorted(set(self.categories) - set(known)):
            raise SetInvalid(f"expected categories among {', '.join(known)}, got {', '.join(unknown)}")
        return [
            Case(
                f"{record['category']}_{_number(record)}",
                record["category"],
                partial(self.load, record),
                plane=Plane(SYMMETRY_NORMAL),
            )
            for record in records
            if not any(record.get(name) for name in HIDDEN)
            and (not self.categories or record["category"] in self.categories)
        ]

    def load(self, record: Mapping[str, object]) -> Scene:
        """Raises CaseUnavailable naming the file that is missing or the field that is wrong."""
        silhouette = read_silhouette(read_bytes(self.root / str(record["mask"]))).coverage
        height, width = silhouette.shape
        if [width, height] != record["img_size"]:
            raise CaseUnavailable(f"expected a mask of {record['img_size']} pixels, got {[width, height]}")
        camera = camera_of_record(record, width, height)
        ground_truth = read_mesh_file(self.root / str(record["model"]))
        coarse = self.coarse.load(str(record["category"]), _number(record), "", camera, ground_truth)
        return Scene(coarse, View(silhouette, camera), ground_truth)


def camera_of_record(record: Mapping[str, object], width: int, height: int) -> Camera:
    """The camera that drew the mask; raises CaseUnavailable or CameraInvalid."""
    try:
        rotation = torch.tensor(record["rot_mat"], dtype=torch.float32).reshape(3, 3)
        translation = torch.tensor(record["trans_mat"], dtype=torch.float32).reshape(3)
        focal = float(str(record["focal_length"])) / SENSOR_WIDTH_MM * width
    except (TypeError, ValueError, RuntimeError) as error:
        raise CaseUnavailable(f"expected numbers in rot_mat, trans_mat and focal_length: {error}") from error
    matrix = torch.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, translation
    to_opencv = torch.tensor([-1.0, -1.0, 1.0, 1.0])
    return Camera(to_opencv[:, None] * matrix, focal, focal, width / 2, height / 2, width, height)


def _number(record: Mapping[str, object]) -> str:
    return PurePosixPath(str(record["img"])).stem
