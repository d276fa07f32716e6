"""What the first bytes of the uploaded files say, refused as the field that they came in."""

from __future__ import annotations

from typing import BinaryIO

from refine_proto import formats, images
from refine_proto.errors import CameraInvalid, FormatUnsupported, InvalidInput, MeshInvalid, SilhouetteInvalid
from refine_proto.formats import MeshFormat
from refine_proto.models import CameraSpec, FieldError, MatrixCamera


def recognise_mesh(head: bytes, filename: str | None, given: MeshFormat | None) -> MeshFormat:
    """`formats.recognise_mesh`; raises MeshInvalid or FormatUnsupported."""
    try:
        return formats.recognise_mesh(head, filename, given)
    except formats.Unsupported as error:
        raise _of("mesh_format", FormatUnsupported, f"{error}, or say its mesh_format") from None
    except formats.Damaged as error:
        raise _of("mesh", MeshInvalid, str(error)) from None


def image_size(file: BinaryIO, part: str) -> tuple[int, int]:
    """Width and height of an image as it is shown; raises SilhouetteInvalid or FormatUnsupported."""
    try:
        return images.read_image_header(file).size
    except formats.Unsupported as error:
        raise _of(part, FormatUnsupported, str(error)) from None
    except formats.Damaged as error:
        raise _of(part, SilhouetteInvalid, str(error)) from None


def check_camera_size(camera: CameraSpec, place: str, width: int, height: int) -> None:
    """Raise CameraInvalid if the camera at `place` says that it belongs to an image of another size."""
    if isinstance(camera, MatrixCamera) and camera.intrinsics is not None:
        try:
            camera.intrinsics.check_size(width, height)
        except ValueError as error:
            raise _of(f"{place}/intrinsics", CameraInvalid, str(error)) from None


def _of(part: str, error: type[InvalidInput], detail: str) -> InvalidInput:
    return error(detail, errors=[FieldError(pointer=f"/{part}", detail=detail)])
