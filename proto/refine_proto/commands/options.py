"""RefinementOptions on the command line, the same for `refine run` and `refine submit`."""

from __future__ import annotations

import argparse

from pydantic import ValidationError

from ..errors import from_validation
from ..models import Checks, Preset, RefinementOptions


def add_options(parser: argparse.ArgumentParser) -> argparse._ArgumentGroup:
    """The arguments for how to refine; what is not given has the model's default."""
    group = parser.add_argument_group("how to refine")
    group.add_argument(
        "--preset", choices=list(Preset), metavar="PRESET", help=f"{', '.join(Preset)} ({Preset.DEFAULT})"
    )
    group.add_argument("--iterations", type=int, metavar="N", help="optimisation steps (the preset's)")
    group.add_argument("--seed", type=int, metavar="N", help="of the network's weights (0)")
    group.add_argument(
        "--symmetry-normal", type=float, nargs=3, metavar=("X", "Y", "Z"),
        help="of the mirror plane, world axes (found on the coarse mesh)",
    )  # fmt: skip
    group.add_argument(
        "--symmetry-offset", type=float, metavar="D",
        help="of the mirror plane along its normal, world units (the coarse mesh decides)",
    )  # fmt: skip
    group.add_argument(
        "--silhouette-threshold", type=float, metavar="T",
        help=f"share of full scale above which is object ({_default('silhouette_threshold')})",
    )  # fmt: skip
    group.add_argument(
        "--checks", choices=list(Checks), metavar="CHECKS",
        help=f"of the inputs, before the run: {', '.join(Checks)} ({_default('checks')})",
    )  # fmt: skip
    return group


def read_options(arguments: argparse.Namespace) -> RefinementOptions:
    """What the arguments say; OptionsInvalid."""
    given = {name: getattr(arguments, name, None) for name in RefinementOptions.model_fields}
    try:
        return RefinementOptions.model_validate({name: v for name, v in given.items() if v is not None})
    except ValidationError as error:
        raise from_validation(error.errors(), under=("options",)) from None


def _default(name: str) -> object:
    return RefinementOptions.model_fields[name].default
