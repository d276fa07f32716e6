"""What a worker says of a result, where a test plays the worker."""

from __future__ import annotations

from refine_proto.models import CameraCorrection, Judgement, MirrorPlane, Outcome, SilhouetteIou

JUDGEMENT = Judgement(
    silhouette_iou=SilhouetteIou(before=0.5, after=0.9),
    outcome=Outcome.FITTED,
    warnings=["expected a closed surface, got 3 holes; they stay"],
    mirror_plane=MirrorPlane(normal=(0.6, 0.0, 0.8), offset=0.25, error=0.01),
    camera_correction=CameraCorrection(turn_degrees=1.5),
)
