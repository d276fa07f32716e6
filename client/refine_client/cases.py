"""Cases: many refinements in one call, each of which succeeds or fails for itself."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

from refine_proto.camera_files import read_camera_file
from refine_proto.errors import InvalidInput
from refine_proto.models import CameraSpec, MeshFormat, RefinementOptions, Webhook
from refine_proto.strict import short

from .upload import Source, View, is_address


@dataclass(frozen=True)
class Case:
    """One of them: the arguments of `RefineClient.submit`."""

    mesh: Source
    silhouette: Source
    camera: CameraSpec | Mapping[str, Any]
    options: RefinementOptions | Mapping[str, Any] | None = None
    ignore: Source | None = None
    views: Sequence[View] = ()
    mesh_format: MeshFormat | str | None = None
    webhook: Webhook | Mapping[str, Any] | None = None
    metadata: Mapping[str, str] = field(default_factory=dict)

    def arguments(self) -> dict[str, Any]:
        """For `submit`."""
        return {each.name: getattr(self, each.name) for each in fields(self)}


def folder_of(directory: Path, number: int) -> Path:
    """Where the artifacts of case `number`, counted from 1, go."""
    return directory / f"{number:04d}"


def read_cases(path: Path) -> list[Case]:
    """From a file with one JSON object a line; paths in it begin at its folder.

    Raises InvalidInput, which names the line, and OSError.
    """
    return list(_cases(path))


def _cases(path: Path) -> Iterator[Case]:
    for number, line in enumerate(path.read_text().splitlines(), 1):
        if not line.strip():
            continue
        try:
            values = json.loads(line)
            if not isinstance(values, dict):
                raise ValueError(f"expected an object, got {short(values)}")
            yield _case(values, path.parent)
        except (ValueError, InvalidInput) as error:
            raise InvalidInput(f"{path}, line {number}: {error}") from None


def _case(values: dict[str, Any], folder: Path) -> Case:
    known = [each.name for each in fields(Case)]
    missing = [name for name in known[:3] if name not in values]
    unknown = [name for name in values if name not in known]
    if missing or unknown:
        got = f"no {missing[0]}" if missing else f"{unknown[0]!r:.60}"
        raise ValueError(f"expected the fields {', '.join(known)}, got {got}")
    views = [_view(view, folder) for view in values.pop("views", [])]
    return Case(**(values | _files(values, folder)), views=views)


def _view(values: Any, folder: Path) -> View:
    if not isinstance(values, dict) or not {"silhouette", "camera"} <= values.keys() <= {
        *View.__match_args__
    }:
        raise ValueError(f"expected views with silhouette, camera and perhaps ignore, got {short(values)}")
    return View(**(values | _files(values, folder)))


def _files(values: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """What in these values is a file or, the camera, may be one."""
    found: dict[str, Any] = {}
    for name in ("mesh", "silhouette", "ignore"):
        source = values.get(name)
        if source is not None and not isinstance(source, str):
            raise ValueError(f"expected {name} to be a path or an https address, got {short(source)}")
        if source is not None:
            found[name] = source if is_address(source) else folder / source
    if isinstance(values["camera"], str):
        found["camera"] = read_camera_file(folder / values["camera"])
    return found
