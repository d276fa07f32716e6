"""What looks wrong with a mesh, its silhouette and its camera before minutes are spent on them.

The coarse mesh is drawn at a low resolution, by the given camera and by every other reading of its numbers:
what a picture shows of a mistake, a 2D IoU tells. docs/checks.md says what each code means, and how often
each finding is right.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F

from refine_proto.cameras import CameraSpec
from refine_proto.checks import Checks, Code, Finding, Severity

from ..errors import (
    CameraInvalid,
    InputError,
    MeshInvalid,
    ObjectOutOfView,
    OptionsInvalid,
    SilhouetteInvalid,
)
from ..method.config import RefineConfig
from ..method.planes import longest_side
from ..method.symmetry import least_mirrored_offset, mirror_error
from ..values import Mesh, View
from .look import FULL, LOW_IOU, MANY_FACES, Look, drawn_box, is_inside, whereabouts

INVERTED_IOU = 0.8  # of the coarse mesh with the background: no accident
CUT_OFF_PIXELS = 0.02  # of the object's longest side, on the border of the image
FEW_PIXELS = 8  # an outline of an object with a shorter longest side says nothing
SYMMETRY_FACTOR = 0.5  # of the given plane's error: what another axis has to have for a finding
SYMMETRY_ERROR = 0.02  # longest sides: with less, the given plane is good enough
COARSE_EDGE = 0.12  # longest sides: a triangle with a longer edge bends an outline at its corners only
COARSE_SHARE = 0.75  # of the surface that such triangles cover
ENOUGH_IOU = 0.8  # a mesh with more need not follow much

ERRORS: Mapping[Code, type[InputError]] = {
    Code.SILHOUETTE_FILLS_IMAGE: SilhouetteInvalid,
    Code.SILHOUETTE_INVERTED: SilhouetteInvalid,
    Code.CAMERA_INSIDE_OBJECT: CameraInvalid,
    Code.OBJECT_OUT_OF_VIEW: ObjectOutOfView,
    Code.NO_OVERLAP: ObjectOutOfView,
    Code.CAMERA_MISREAD: CameraInvalid,
    Code.LOW_OVERLAP: CameraInvalid,
    Code.OBJECT_TOO_SMALL: SilhouetteInvalid,
    Code.SILHOUETTE_CUT_OFF: SilhouetteInvalid,
    Code.SYMMETRY_ELSEWHERE: OptionsInvalid,
    Code.MESH_TOO_COARSE: MeshInvalid,
}
"""As what a refused finding is raised."""
AXES = {"X": (1.0, 0.0, 0.0), "Y": (0.0, 1.0, 0.0), "Z": (0.0, 0.0, 1.0)}


@dataclass(frozen=True)
class GivenPlane:
    """A mirror plane that a caller gives instead of having it found."""

    normal: Sequence[float]  # world axes, any length but zero
    offset: float | None = None  # world units; None: anywhere along the normal

    @staticmethod
    def of(config: RefineConfig) -> GivenPlane | None:
        """That of a configuration, if it has one."""
        given = config.symmetry == "plane"
        return GivenPlane(config.symmetry_normal, config.symmetry_offset) if given else None


def check_inputs(
    mesh: Mesh,
    view: View,
    spec: CameraSpec,
    checks: Checks = Checks.WARN,
    symmetry: GivenPlane | None = None,
) -> tuple[Finding, ...]:
    """What looks wrong, the likelier cause first; `spec` is what `view.camera` was read from.

    Takes tenths of a second whatever the size of the mesh. Nothing is raised: see `refuse`.
    """
    looked = Look(mesh, view, spec)
    found = [*_about_the_silhouette(looked), *_about_the_camera(looked), *_about_the_size(looked)]
    if symmetry is not None:
        found += _about_the_symmetry(looked.thin, symmetry)
    found += () if found else _about_the_triangles(looked)
    return tuple(_judged(finding, checks) for finding in found)


def refuse(findings: Iterable[Finding]) -> None:
    """Raise the InputError for those that refuse the request, the first one's kind in all their words."""
    refused = [finding for finding in findings if finding.severity is Severity.REFUSED]
    if refused:
        message = "; ".join(finding.message for finding in refused)
        raise ERRORS[refused[0].code](f"{message} (options.checks: {Checks.OFF} refines it all the same)")


def _judged(finding: Finding, checks: Checks) -> Finding:
    if checks == Checks.WARN:
        return finding
    severity = Severity.REFUSED if checks == Checks.STRICT else Severity.WARNING
    return finding.model_copy(update={"severity": severity})


def _about_the_silhouette(looked: Look) -> Iterator[Finding]:
    if looked.covered > FULL:
        yield _finding(
            Code.SILHOUETTE_FILLS_IMAGE,
            "expected background around the object, got a silhouette that covers "
            f"{looked.covered:.1%} of the image; is its alpha channel opaque where there is no object?",
        )
    if looked.inverted:
        yield _finding(
            Code.SILHOUETTE_INVERTED,
            "expected the object in white or opaque, got a silhouette whose background fits the coarse mesh "
            f"better: a 2D IoU of {looked.background_iou:.2f}, the object {looked.iou:.2f}; invert it",
            refused=looked.background_iou > INVERTED_IOU,
        )
    elif looked.covered <= FULL and (touched := _touched_border(looked)):
        yield _finding(
            Code.SILHOUETTE_CUT_OFF,
            f"expected the whole object in the image, got one that is cut off at the {touched}; "
            "a larger picture shows the rest, of which the silhouette says nothing",
        )


def _touched_border(looked: Look) -> str:
    """The sides of the image at which the object ends, in words; "" for none."""
    silhouette = looked.object
    sides = {
        "top": silhouette[0],
        "bottom": silhouette[-1],
        "left": silhouette[:, 0],
        "right": silhouette[:, -1],
    }
    return ", ".join(name for name, edge in sides.items() if int(edge.sum()) > CUT_OFF_PIXELS * looked.extent)


def _about_the_camera(looked: Look) -> Iterator[Finding]:
    """Where it is, or what it does not see, or how it is misread: the first of these that there is."""
    if looked.camera.projection == "perspective" and is_inside(looked.mesh, looked.camera):
        yield _finding(
            Code.CAMERA_INSIDE_OBJECT,
            "expected a camera outside the object, got one within it: are mesh and camera in the same unit "
            f"of length{looked.hint or '?'}",
            looked,
            refused=True,
        )
    elif not looked.rendered.any():
        yield _finding(
            Code.OBJECT_OUT_OF_VIEW,
            f"expected the object in the image, got {whereabouts(looked.mesh, looked.camera)}{looked.hint}",
            looked,
            refused=True,
        )
    elif looked.iou == 0.0 and not looked.inverted:
        yield _finding(
            Code.NO_OVERLAP,
            "expected the coarse mesh where the silhouette is, got one beside it: their 2D IoU is 0"
            f"{looked.hint or '; check the camera and where the mesh is'}",
            looked,
            refused=True,
        )
    elif looked.reading is not None:
        yield _finding(
            Code.CAMERA_MISREAD,
            "expected a camera by which the coarse mesh fits its silhouette, got one with a 2D IoU of "
            f"{looked.iou:.2f}{looked.hint}",
            looked,
        )
    elif looked.iou < LOW_IOU and not looked.inverted and looked.covered <= FULL:
        yield _finding(
            Code.LOW_OVERLAP,
            f"expected a coarse mesh with a 2D IoU of at least {LOW_IOU:g} with its silhouette, got "
            f"{looked.iou:.2f}, and no usual reading of the camera is better; check the camera, the mesh and "
            "that both are of this picture",
        )


def _about_the_size(looked: Look) -> Iterator[Finding]:
    if looked.extent < FEW_PIXELS:
        yield _finding(
            Code.OBJECT_TOO_SMALL,
            f"expected an object of at least {FEW_PIXELS} pixels in the silhouette, got one of "
            f"{looked.extent}; crop the picture and enlarge it",
        )
    elif looked.rendered.any():
        low, high = drawn_box(looked.mesh, looked.camera)
        if (drawn := float((high - low).max())) < FEW_PIXELS:
            yield _finding(
                Code.OBJECT_TOO_SMALL,
                f"expected a coarse mesh of at least {FEW_PIXELS} pixels under the camera, got one of "
                f"{drawn:.2g}; are mesh and camera in the same unit of length?",
                looked,
            )


def _about_the_symmetry(mesh: Mesh, plane: GivenPlane) -> Iterator[Finding]:
    """The given plane against those across the world's axes: how far the mirrored surface is from itself."""
    side = longest_side(mesh)
    normal = F.normalize(mesh.vertices.new_tensor(plane.normal), dim=0)
    at = least_mirrored_offset(mesh, normal) if plane.offset is None else plane.offset
    given = mirror_error(mesh, normal)(at) / side
    if given < SYMMETRY_ERROR:
        return
    others = {}
    for name, axis in AXES.items():
        other = normal.new_tensor(axis)
        if abs(float(other @ normal)) < 0.999 or plane.offset is not None:
            others[name] = mirror_error(mesh, other)(least_mirrored_offset(mesh, other)) / side
    name, error = min(others.items(), key=lambda item: item[1])
    if error < SYMMETRY_FACTOR * given:
        across = " ".join(f"{x:g}" for x in AXES[name])
        yield _finding(
            Code.SYMMETRY_ELSEWHERE,
            f"expected a mirror plane that mirrors the mesh, got one that is off by {given:.3f} of its "
            f"longest side; one across {name} is off by {error:.3f}: give symmetry_normal {across} "
            "without an offset, or leave it out to have the plane found",
        )


def _about_the_triangles(looked: Look) -> Iterator[Finding]:
    """Whether there are enough vertices to follow the silhouette; many triangles are never too few."""
    mesh = looked.mesh
    if len(mesh.faces) > MANY_FACES or looked.iou >= ENOUGH_IOU:
        return
    corners = mesh.vertices[mesh.faces]
    edges = corners - corners.roll(1, 1)
    area = torch.linalg.cross(edges[:, 0], edges[:, 1]).norm(dim=1)
    coarse = edges.norm(dim=2).amax(1) > COARSE_EDGE * longest_side(mesh)
    if float(area[coarse].sum()) > COARSE_SHARE * float(area.sum()):
        yield _finding(
            Code.MESH_TOO_COARSE,
            f"expected triangles that are small enough to follow the silhouette, got {len(mesh.faces)}, most "
            f"with an edge above {COARSE_EDGE:g} of the object's size; the option subdivide splits them",
        )


def _finding(code: Code, message: str, looked: Look | None = None, refused: bool = False) -> Finding:
    severity = Severity.REFUSED if refused else Severity.WARNING
    reading = looked.reading if looked else None
    return Finding(code=code, severity=severity, message=message, reading=reading)
