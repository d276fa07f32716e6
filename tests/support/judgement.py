"""What a worker says of a result, and of an estimated camera, where a test plays the worker."""

from __future__ import annotations

from refine_proto.models import (
    CameraAlternative,
    CameraCorrection,
    CameraEstimate,
    Judgement,
    MatrixCamera,
    MeshCounts,
    MirrorPlane,
    Outcome,
    SilhouetteIou,
)

_ROWS = [[1, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 2], [0, 0, 0, 1]]
_CAMERA = MatrixCamera.model_validate(
    {"type": "matrix", "convention": "opencv", "world_to_camera": _ROWS, "fov_y_degrees": 45}
)
ESTIMATE = CameraEstimate(
    camera=_CAMERA,
    silhouette_iou=0.75,
    azimuth_degrees=-30.0,
    elevation_degrees=12.0,
    alternatives=[
        CameraAlternative(
            camera=_CAMERA,
            silhouette_iou=0.5,
            azimuth_degrees=30.0,
            elevation_degrees=-12.0,
            mirror_ambiguous=True,
        )
    ],
)
JUDGEMENT = Judgement(
    silhouette_iou=SilhouetteIou(before=0.5, after=0.9),
    outcome=Outcome.FITTED,
    warnings=["expected a closed surface, got 3 holes; they stay"],
    mirror_plane=MirrorPlane(normal=(0.6, 0.0, 0.8), offset=0.25, error=0.01),
    camera_correction=CameraCorrection(turn_degrees=1.5),
    camera=ESTIMATE,
    mesh_counts=MeshCounts(
        vertices=8,
        faces=12,
        source_vertices=24,
        optimised_vertices=1500,
        optimised_faces=2996,
        refined_vertices=1500,
        refined_faces=2900,
        removed_faces=96,
    ),
)
