"""ShapeNet with the 3D-R2N2 renderings, and every set rendered in that layout (RerenderedShapeNet).

    RENDERINGS/<synset>/<model>/rendering/00.png ... 23.png     RGBA, 137 x 137
    RENDERINGS/<synset>/<model>/rendering/rendering_metadata.txt one line per image
    MODELS/<synset>/<model>/model.obj                            ShapeNetCore v1

A line of metadata: azimuth, elevation, in-plane rotation (degrees), distance / 1.75, and a field of view. The
camera stands at distance * (cos e cos a, sin e, cos e sin a) of the model's frame (Y up) and looks at the
origin. Its lens is Blender's default, 35 mm on a 32 mm sensor; the file's field of view (25) is not used.
Sources: shapenet/utils/coords.py of Mesh R-CNN, pytorch3d/datasets/r2n2, and Pixel2Mesh's camera_info.

The left and right of ShapeNetCore v1 are +-Z, so the symmetry plane is the paper's z = 0.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from refine_engine.files.silhouette import read_silhouette
from refine_engine.values import Camera, View

from ..asymmetry import ASYMMETRIC_FROM, image_asymmetry
from ..cases import (
    Case,
    CaseSkipped,
    CaseUnavailable,
    Plane,
    Scene,
    SetInvalid,
    existing_folder,
    read_bytes,
    read_mesh_file,
    subfolders,
)  # fmt: skip
from ..coarse_files import CoarseFolder

SYNSETS: Mapping[str, str] = {
    "02691156": "airplane",
    "02828884": "bench",
    "02933112": "cabinet",
    "02958343": "car",
    "03001627": "chair",
    "03211117": "display",
    "03636649": "lamp",
    "03691459": "speaker",
    "04090263": "rifle",
    "04256520": "sofa",
    "04379243": "table",
    "04401088": "phone",
    "04530566": "vessel",
}
MAX_CAMERA_DISTANCE = 1.75  # of 3D-R2N2: the unit of the fourth column
FOV_DEGREES = 2 * math.degrees(math.atan(32 / 2 / 35))
METADATA = "rendering_metadata.txt"


@dataclass(frozen=True)
class ShapeNet:
    """Where the parts of the set lie, and which part of it is asked for."""

    renderings: Path
    models: Path
    coarse: CoarseFolder
    view: int = 0
    """Which of the 24 images of a model."""
    categories: Collection[str] = ()
    """Names or synsets; empty: all 13 of 3D-R2N2."""
    instances: Collection[str] = ()
    """`<synset>/<model>` of a split; empty: all that were rendered."""
    asymmetric: bool = False
    """Only ShapeNetAsym: ground truth whose image symmetry loss is not below 0.01."""

    def cases(self) -> list[Case]:
        """One case per rendered model; raises SetInvalid when the layout is not the published one."""
        existing_folder(self.renderings, "the 3D-R2N2 renderings")
        existing_folder(self.models, "ShapeNetCore v1")
        existing_folder(self.coarse.folder, "the coarse meshes")
        unknown = set(self.categories) - set(SYNSETS) - set(SYNSETS.values())
        if unknown:
            raise SetInvalid(
                f"expected categories among {', '.join(SYNSETS.values())}, got {', '.join(sorted(unknown))}"
            )
        synsets = [folder for folder in subfolders(self.renderings) if self._wanted(folder.name)]
        if not synsets:
            raise SetInvalid(
                f"expected synset folders such as 02691156 in {self.renderings}, got "
                f"{', '.join(f.name for f in subfolders(self.renderings)[:5]) or 'no folder'}"
            )
        found = [(synset.name, model.name) for synset in synsets for model in subfolders(synset)]
        chosen = [pair for pair in found if not self.instances or "/".join(pair) in self.instances]
        rendered = {"/".join(pair) for pair in found}
        for name in sorted(set(self.instances) - rendered):  # of the split, but half downloaded
            synset, _, model = name.partition("/")
            chosen.append((synset, model))
        return [
            Case(
                f"{SYNSETS[synset]}_{model}_{self.view:02}",
                SYNSETS[synset],
                partial(self.load, synset, model),
                asymmetric=self.asymmetric,  # `load` skips the others
                plane=Plane((0.0, 0.0, 1.0)),
            )
            for synset, model in chosen
            if self._wanted(synset)
        ]

    def _wanted(self, synset: str) -> bool:
        return synset in SYNSETS and (
            not self.categories or synset in self.categories or SYNSETS[synset] in self.categories
        )

    def load(self, synset: str, model: str) -> Scene:
        """Raises CaseUnavailable naming the file that is missing, CaseSkipped for a symmetric model."""
        folder = self.renderings / synset / model / "rendering"
        image = f"{self.view:02}"
        silhouette = read_silhouette(read_bytes(folder / f"{image}.png")).coverage
        height, width = silhouette.shape
        camera = camera_of_line(_line(folder / METADATA, self.view), width, height)
        ground_truth = read_mesh_file(self.models / synset / model / "model.obj")
        if self.asymmetric and (loss := image_asymmetry(ground_truth)) < ASYMMETRIC_FROM:
            raise CaseSkipped(
                f"not in ShapeNetAsym: its image symmetry loss {loss:.4f} is below {ASYMMETRIC_FROM}"
            )
        coarse = self.coarse.load(synset, model, image, camera, ground_truth)
        return Scene(coarse, View(silhouette, camera), ground_truth)


def camera_of_line(line: str, width: int, height: int) -> Camera:
    """The camera of one line of rendering_metadata.txt; raises CaseUnavailable when it is not one."""
    try:
        azimuth, elevation, roll, ratio, _ = (float(word) for word in line.split())
    except ValueError as error:
        raise CaseUnavailable(
            f"expected azimuth, elevation, in-plane rotation, distance and field of view, got {line!r:.80}"
        ) from error
    if roll != 0.0:
        raise CaseUnavailable(f"expected an in-plane rotation of 0, as everywhere in 3D-R2N2, got {roll:g}")
    # (cos a, sin a) of the file about X -> Z is (sin, cos) of the azimuth of Camera.look_at, about Z -> X
    return Camera.look_at(90.0 - azimuth, elevation, MAX_CAMERA_DISTANCE * ratio, FOV_DEGREES, width, height)


def metadata_line(azimuth_degrees: float, elevation_degrees: float, distance: float) -> str:
    """The inverse of `camera_of_line`; the angle is that of Camera.look_at."""
    azimuth, ratio = (90.0 - azimuth_degrees) % 360.0, distance / MAX_CAMERA_DISTANCE
    return f"{azimuth:.6f} {elevation_degrees:.6f} 0 {ratio:.6f} 25"


def _line(path: Path, number: int) -> str:
    lines = [line for line in read_bytes(path).decode("ascii", "replace").splitlines() if line.strip()]
    if number >= len(lines):
        raise CaseUnavailable(
            f"expected at least {number + 1} lines in {path}, one per image, got {len(lines)}"
        )
    return lines[number]
