"""Cameras in the files that other programs write: a CameraSpec, NeRF's transforms.json, a COLMAP model.

    camera.json                  one CameraSpec
    transforms.json#r_0          NeRF, instant-ngp, nerfstudio: the frame whose file_path is or ends in this
    sparse/0#IMG_0042.jpg        COLMAP: a folder with cameras.txt and images.txt, the image of this name
    estimate                     no file: the camera is estimated

The name after # may be left out where there is one camera only. The world is that of the file: the mesh has
to be in it. Lens distortion is refused: a silhouette belongs to the undistorted image.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Any

from pydantic import ValidationError

from .cameras import CAMERA_SPEC, CameraSpec, EstimatedCamera
from .errors import CameraInvalid, from_validation

ESTIMATE = "estimate"  # in place of a file
DISTORTION = 1e-2  # of a coefficient: below it an outline moves by less than a pixel or so
_DISTORTIONS = ("k1", "k2", "k3", "k4", "p1", "p2")
# COLMAP's camera models: where fx, fy, cx, cy stand among the parameters; what follows is distortion.
_COLMAP_LENS: Mapping[str, tuple[int, int, int, int]] = {
    "SIMPLE_PINHOLE": (0, 0, 1, 2),
    "PINHOLE": (0, 1, 2, 3),
    "SIMPLE_RADIAL": (0, 0, 1, 2),
    "RADIAL": (0, 0, 1, 2),
    "OPENCV": (0, 1, 2, 3),
    "FULL_OPENCV": (0, 1, 2, 3),
}


def read_camera_file(path: str | os.PathLike[str], under: Sequence[str | int] = ("camera",)) -> CameraSpec:
    """The camera in a file of one of the above kinds; `under` is where it will sit in a request.

    Raises CameraInvalid, or OSError for a file that cannot be read.
    """
    if str(path) == ESTIMATE:
        return EstimatedCamera()
    place, name = _split(Path(path))
    if place.is_dir():
        return _chosen(
            colmap_cameras(_text(place / "cameras.txt"), _text(place / "images.txt")), name, place, under
        )
    data = place.read_bytes()
    try:
        frames = json.loads(data).get("frames")
    except (ValueError, AttributeError):
        frames = None
    if isinstance(frames, list):
        return _chosen(nerf_cameras(json.loads(data)), name, place, under)
    if name is not None:
        raise CameraInvalid(f"expected a transforms.json or a COLMAP folder before #{name}, got {place}")
    return _validated(data, under)


def nerf_cameras(transforms: Mapping[str, Any]) -> dict[str, Mapping[str, Any]]:
    """The frames of a transforms.json by file_path, each as a CameraSpec that is not checked yet."""
    cameras: dict[str, Mapping[str, Any]] = {}
    for frame in transforms["frames"]:
        if not isinstance(frame, dict) or not {"file_path", "transform_matrix"} <= frame.keys():
            raise CameraInvalid("expected frames with a file_path and a transform_matrix, got one without")
        cameras[str(frame["file_path"])] = {
            "type": "matrix",
            "convention": "opengl",
            "camera_to_world": frame["transform_matrix"],
            **_nerf_lens({**transforms, **frame}),
        }
    return cameras


def _nerf_lens(values: Mapping[str, Any]) -> dict[str, Any]:
    """fl_x, fl_y, cx, cy, w, h in pixels, or camera_angle_x or _y in radians."""
    try:
        _check_undistorted({name: float(values.get(name, 0.0)) for name in _DISTORTIONS})
        if "fl_x" in values and {"w", "h"} <= values.keys():
            fx, width, height = float(values["fl_x"]), int(values["w"]), int(values["h"])
            lens = {"fx": fx, "fy": float(values.get("fl_y", fx)), "width": width, "height": height}
            centre = {"cx": float(values.get("cx", width / 2)), "cy": float(values.get("cy", height / 2))}
            return {"intrinsics": lens | centre}
        for axis in "xy":
            if f"camera_angle_{axis}" in values:
                return {f"fov_{axis}_degrees": math.degrees(float(values[f"camera_angle_{axis}"]))}
    except (TypeError, ValueError, OverflowError) as error:
        raise CameraInvalid(f"expected numbers for the lens in transforms.json, got: {error}") from None
    raise CameraInvalid("expected camera_angle_x, or fl_x, w and h, in transforms.json, got none of them")


def colmap_cameras(cameras: str, images: str) -> dict[str, Mapping[str, Any]]:
    """The images of a COLMAP text model by name, each as a CameraSpec that is not checked yet."""
    lenses = {}
    for words in _lines(cameras):
        if words:
            lenses[words[0]] = words[1:]
    found: dict[str, Mapping[str, Any]] = {}
    lines = _lines(images)
    for words in lines:
        if not words:
            continue
        next(lines, None)  # its points, a line that may be empty
        try:
            rotation = _rotation(*(float(word) for word in words[1:5]))
            shift = [float(word) for word in words[5:8]]
            camera, name = words[8], " ".join(words[9:])
            intrinsics = _colmap_lens(lenses[camera])
        except (LookupError, ValueError, TypeError, ZeroDivisionError) as error:
            raise CameraInvalid(
                f"expected IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME and its camera in the COLMAP model, "
                f"got {' '.join(words)[:80]!r} ({type(error).__name__}: {error})"
            ) from None
        found[name] = {
            "type": "matrix",
            "convention": "opencv",
            "world_to_camera": [[*row, t] for row, t in zip(rotation, shift, strict=True)],
            "intrinsics": intrinsics,
        }
    return found


def _colmap_lens(words: Sequence[str]) -> dict[str, float]:
    model, numbers = words[0], [float(word) for word in words[3:]]
    if model not in _COLMAP_LENS:
        raise CameraInvalid(
            f"expected one of COLMAP's camera models {', '.join(_COLMAP_LENS)}, got {model}; undistort"
        )
    at = _COLMAP_LENS[model]
    _check_undistorted({f"parameter {i + 1}": numbers[i] for i in range(at[3] + 1, len(numbers))})
    lens = dict(zip(("fx", "fy", "cx", "cy"), (numbers[i] for i in at), strict=True))
    return lens | {"width": int(words[1]), "height": int(words[2])}


def _rotation(w: float, x: float, y: float, z: float) -> list[list[float]]:
    """The rows of the rotation of a quaternion of any length."""
    norm = math.sqrt(w * w + x * x + y * y + z * z)
    w, x, y, z = w / norm, x / norm, y / norm, z / norm
    return [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]


def _check_undistorted(coefficients: Mapping[str, float]) -> None:
    strong = [f"{name} {value:g}" for name, value in coefficients.items() if abs(value) > DISTORTION]
    if strong:
        raise CameraInvalid(
            f"expected a lens without distortion, got {', '.join(strong)}; undistort the silhouette"
        )


def _lines(text: str) -> Iterator[list[str]]:
    """The words of each line that is no comment; an empty line has none."""
    yield from (line.split() for line in text.splitlines() if not line.lstrip().startswith("#"))


def _text(path: Path) -> str:
    return path.read_text(encoding="utf-8", errors="replace")


def _split(path: Path) -> tuple[Path, str | None]:
    """The file and the name after #, which a file's own name may hold too."""
    place, mark, name = str(path).rpartition("#")
    return (path, None) if path.exists() or not mark else (Path(place), name)


def _chosen(
    cameras: Mapping[str, Mapping[str, Any]], name: str | None, place: Path, under: Sequence[str | int]
) -> CameraSpec:
    """The camera of that name: the whole, or its end, with or without the suffix."""
    fits = [key for key in cameras if name is None or key == name]
    fits = fits or [key for key in cameras if name is not None and _ends_in(key, name)]
    if len(fits) != 1:
        some = ", ".join(list(cameras)[:5]) + (", ..." if len(cameras) > 5 else "")
        got = f"{len(fits)} of that name" if name else f"{len(cameras)}"
        raise CameraInvalid(
            f"expected one camera as {place}#{name or 'NAME'}, got {got}; there are: {some or 'none'}"
        )
    return _validated(cameras[fits[0]], under)


def _ends_in(key: str, name: str) -> bool:
    """Whether the last steps of a path are those of `name`; the suffix counts only where both have one."""
    path, wanted = PurePosixPath(key), PurePosixPath(name)
    if not path.suffix or not wanted.suffix:
        path, wanted = path.parent / path.stem, wanted.parent / wanted.stem
    return bool(wanted.parts) and path.parts[-len(wanted.parts) :] == wanted.parts


def _validated(camera: bytes | Mapping[str, Any], under: Sequence[str | int]) -> CameraSpec:
    try:
        if isinstance(camera, bytes):
            return CAMERA_SPEC.validate_json(camera)
        return CAMERA_SPEC.validate_python(camera)
    except ValidationError as error:
        raise from_validation(error.errors(), under=under) from None
