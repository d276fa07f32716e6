"""What the first bytes of the uploaded files say, refused as the field that they came in."""

from __future__ import annotations

from refine_proto import formats
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


def silhouette_size(head: bytes) -> tuple[int, int]:
    """`formats.png_size`; raises SilhouetteInvalid or FormatUnsupported."""
    try:
        return formats.png_size(head)
    except formats.Unsupported as error:
        raise _of("silhouette", FormatUnsupported, str(error)) from None
    except formats.Damaged as error:
        raise _of("silhouette", SilhouetteInvalid, str(error)) from None


def check_camera_size(camera: CameraSpec, width: int, height: int) -> None:
    """Raise CameraInvalid if the camera says that it belongs to an image of another size."""
    if isinstance(camera, MatrixCamera) and camera.intrinsics is not None:
        try:
            camera.intrinsics.check_size(width, height)
        except ValueError as error:
            raise _of("camera/intrinsics", CameraInvalid, str(error)) from None


def _of(part: str, error: type[InvalidInput], detail: str) -> InvalidInput:
    return error(detail, errors=[FieldError(pointer=f"/{part}", detail=detail)])
