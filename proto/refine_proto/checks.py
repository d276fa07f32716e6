"""What is found wrong with readable inputs before they are refined: a Finding each, under a stable code.

docs/checks.md lists the codes, when each is found and what to do about it.
"""

from __future__ import annotations

from enum import StrEnum
from typing import Any

from pydantic import BaseModel, Field, ValidationError, ValidatorFunctionWrapHandler, field_validator

from .cameras import CameraSpec
from .open_enum import OpenEnum


class Checks(StrEnum):
    """What becomes of a finding."""

    STRICT = "strict"  # every finding refuses the request
    WARN = "warn"  # what cannot be meant is refused, the rest is a warning
    OFF = "off"  # the inputs are refined as they are


class Severity(OpenEnum):
    """What a finding does to a refinement with the options that were given."""

    WARNING = "warning"
    REFUSED = "refused"


class Code(OpenEnum):
    """What is wrong, likelier causes of the others first."""

    SILHOUETTE_FILLS_IMAGE = "SILHOUETTE_FILLS_IMAGE"
    SILHOUETTE_INVERTED = "SILHOUETTE_INVERTED"
    CAMERA_INSIDE_OBJECT = "CAMERA_INSIDE_OBJECT"
    OBJECT_OUT_OF_VIEW = "OBJECT_OUT_OF_VIEW"
    NO_OVERLAP = "NO_OVERLAP"
    CAMERA_MISREAD = "CAMERA_MISREAD"
    LOW_OVERLAP = "LOW_OVERLAP"
    OBJECT_TOO_SMALL = "OBJECT_TOO_SMALL"
    SILHOUETTE_CUT_OFF = "SILHOUETTE_CUT_OFF"
    SYMMETRY_ELSEWHERE = "SYMMETRY_ELSEWHERE"
    MESH_TOO_COARSE = "MESH_TOO_COARSE"


class Reading(BaseModel, frozen=True, extra="ignore", allow_inf_nan=False):
    """Another camera that the same numbers could mean."""

    name: str = Field(description="What was mistaken for what, for instance `azimuth negated`.")
    silhouette_iou: float = Field(description="2D IoU of the coarse mesh with the silhouette under it.")
    camera: CameraSpec = Field(description="The camera to send instead.")


class Finding(BaseModel, frozen=True, extra="ignore", allow_inf_nan=False):
    """One thing that looks wrong."""

    code: Code
    severity: Severity
    message: str = Field(description="What was expected, what came and what to do next.")
    reading: Reading | None = Field(None, description="The reading of the camera that fits better.")

    @field_validator("reading", mode="wrap")
    @classmethod
    def _leave_out_a_camera_of_a_newer_server(
        cls, value: Any, read: ValidatorFunctionWrapHandler
    ) -> Reading | None:
        try:
            found: Reading | None = read(value)
        except ValidationError:
            return None
        return found
