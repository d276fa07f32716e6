"""An estimated camera, on standard output."""

from __future__ import annotations

from ..models import CameraAlternative, CameraEstimate


def print_estimate(estimate: CameraEstimate, as_json: bool) -> None:
    """One JSON object, or a line for the camera and one for every alternative."""
    if as_json:
        print(estimate.model_dump_json(exclude_none=True))
        return
    print(f"camera       {_line(estimate)}")
    for other in estimate.alternatives:
        print(f"alternative  {_line(other)}{', mirror-ambiguous' if other.mirror_ambiguous else ''}")


def _line(camera: CameraEstimate | CameraAlternative) -> str:
    return (
        f"azimuth {camera.azimuth_degrees:.0f}, elevation {camera.elevation_degrees:.0f}, "
        f"2D IoU {camera.silhouette_iou:.3f}"
    )
