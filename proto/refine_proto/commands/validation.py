"""What was found in the inputs of a refinement, on standard output."""

from __future__ import annotations

from ..models import Validation


def print_validation(validation: Validation, as_json: bool) -> None:
    """One JSON object, or a line of verdict and one for everything that was found, under its code."""
    if as_json:
        print(validation.model_dump_json(exclude_none=True))
        return
    verdict = "can be refined" if validation.accepted else "refused"
    print(f"{verdict}, 2D IoU {validation.silhouette_iou:.3f}")
    for finding in validation.checks:
        print(f"{finding.severity} {finding.code}: {finding.message}")
    told = {finding.message for finding in validation.checks}
    for warning in validation.warnings:
        if warning not in told:
            print(f"warning: {warning}")
