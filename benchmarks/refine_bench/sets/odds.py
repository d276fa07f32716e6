"""3D-ODDS, the 3D Object Domain Dataset Suite published with REFINE: OOWL (drone), OWILD (in the wild).

    **/<DOMAIN>_<Object_Name>_<angle>.png   RGBA, the object in alpha: OOWL_Some_Whipped_Cream_Can_090.png
    **/<Object_Name>.obj                    ground truth
    ROOT/cameras.json                       {"<image name without .png>": a camera of docs/conventions.md}

The names are those of the files that its authors published beside their code; files are found by name in any
folder, because the published archive is the only description of its folders. Cameras are estimates that each
user of the set makes, so they come in a file of their own.
"""

from __future__ import annotations

import json
import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from refine_engine.cameras.spec import read_camera
from refine_engine.request import read_view

from ..cases import Case, CaseUnavailable, Scene, SetInvalid, existing_folder, read_bytes, read_mesh_file
from ..coarse_files import CoarseFolder

IMAGE = re.compile(r"(?P<domain>[A-Z]+)_(?P<object>.+)_(?P<angle>\d{3})")


@dataclass(frozen=True)
class Odds:
    """Where the set lies, and which part of it is asked for."""

    root: Path
    coarse: CoarseFolder
    categories: Collection[str] = ()
    """Domains, such as OOWL; empty: all."""

    def cases(self) -> list[Case]:
        """One case per image, its domain as category; SetInvalid when no image has a published name."""
        existing_folder(self.root, "3D-ODDS")
        existing_folder(self.coarse.folder, "the coarse meshes")
        images = {path.stem: path for path in sorted(self.root.rglob("*.png")) if IMAGE.fullmatch(path.stem)}
        if not images:
            raise SetInvalid(f"expected images such as OOWL_Some_Can_090.png below {self.root}, got none")
        models = {path.stem: path for path in sorted(self.root.rglob("*.obj"))}
        cameras = self._cameras()
        cases = []
        for name, path in images.items():
            match = IMAGE.fullmatch(name)
            assert match is not None
            domain, model = match["domain"], models.get(match["object"])
            if not self.categories or domain in self.categories:
                load = partial(self.load, path, match["object"], model, cameras.get(name))
                cases.append(Case(name, domain, load))
        return cases

    def _cameras(self) -> Mapping[str, object]:
        path = self.root / "cameras.json"
        try:
            cameras = json.loads(path.read_bytes())
        except OSError as error:
            raise SetInvalid(
                f"expected {path}, a camera for each image, got none ({error.strerror})"
            ) from error
        except ValueError as error:
            raise SetInvalid(f"expected JSON in {path}, got something else ({error})") from error
        if not isinstance(cameras, dict):
            raise SetInvalid(f"expected a JSON object in {path}, got {type(cameras).__name__}")
        return cameras

    def load(self, image: Path, name: str, model: Path | None, spec: object) -> Scene:
        """Raises CaseUnavailable naming what is missing."""
        if model is None:
            raise CaseUnavailable(f"expected the ground truth {name}.obj below {self.root}, got none")
        if not isinstance(spec, dict):
            raise CaseUnavailable(
                f"expected a camera for {image.stem} in {self.root / 'cameras.json'}, got none"
            )
        view = read_view(read_bytes(image), read_camera(spec))
        ground_truth = read_mesh_file(model)
        coarse = self.coarse.load(
            IMAGE.sub(r"\g<domain>", image.stem), image.stem, "", view.camera, ground_truth
        )
        return Scene(coarse, view, ground_truth)
