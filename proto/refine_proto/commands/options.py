"""What `refine run` and `refine submit` take alike: the views, and RefinementOptions."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from pydantic import ValidationError

from ..errors import InvalidInput, from_validation
from ..formats import MAX_VIEWS
from ..models import Checks, Preset, RefinementOptions, Symmetry, Topology


class ViewPaths(NamedTuple):
    """The files of one view."""

    silhouette: Path | str  # a text is an address
    camera: Path
    ignore: Path | str | None = None
    place: tuple[str | int, ...] = ("camera",)  # where the camera sits in a request


def add_views(parser: argparse.ArgumentParser, source: Callable[[str], Path | str] = Path) -> None:
    """The arguments for what was seen: a silhouette with its camera, and further views.

    `source` reads what names an image.
    """
    parser.add_argument(
        "silhouette", type=source, metavar="SILHOUETTE",
        help="PNG, JPEG, WebP, TIFF or BMP: alpha, or white on black",
    )  # fmt: skip
    parser.add_argument(
        "--camera", type=Path, required=True, metavar="CAMERA.json",
        help="of the silhouette; or transforms.json#FRAME, COLMAP_FOLDER#IMAGE, estimate",
    )  # fmt: skip
    parser.add_argument(
        "--ignore", type=source, metavar="IMAGE", help="where it shows an object, nothing is known (none)"
    )
    parser.add_argument(
        "--view", dest="views", action="append", default=[], type=source, nargs="+",
        metavar=("SILHOUETTE CAMERA.json", "IGNORE"),
        help="a further view of the same object, as often as there are any",
    )  # fmt: skip


def read_views(arguments: argparse.Namespace) -> list[ViewPaths]:
    """The views that the arguments name, at least one; InvalidInput."""
    for paths in arguments.views:
        if len(paths) not in (2, 3):
            raise InvalidInput(
                f"expected --view SILHOUETTE CAMERA.json [IGNORE], got {len(paths)} "
                f"file{'s' if len(paths) > 1 else ''}: {' '.join(map(str, paths))}"
            )
    further = [
        ViewPaths(paths[0], Path(paths[1]), paths[2] if len(paths) > 2 else None, ("views", number, "camera"))
        for number, paths in enumerate(arguments.views)
    ]
    if len(further) >= MAX_VIEWS:
        raise InvalidInput(f"expected at most {MAX_VIEWS} views, got {len(further) + 1}")
    return [ViewPaths(arguments.silhouette, arguments.camera, arguments.ignore), *further]


def add_options(parser: argparse.ArgumentParser) -> argparse._ArgumentGroup:
    """The arguments for how to refine; what is not given has the model's default."""
    group = parser.add_argument_group("how to refine")
    group.add_argument(
        "--preset", choices=list(Preset), metavar="PRESET", help=f"{', '.join(Preset)} ({Preset.DEFAULT})"
    )
    group.add_argument("--iterations", type=int, metavar="N", help="optimisation steps (the preset's)")
    group.add_argument("--seed", type=int, metavar="N", help="of the network's weights (0)")
    group.add_argument(
        "--symmetry", choices=list(Symmetry), metavar="WHICH",
        help="mirror plane: auto, from the coarse mesh; plane, as given; none (auto, without a given plane)",
    )  # fmt: skip
    group.add_argument(
        "--symmetry-normal", type=float, nargs=3, metavar=("X", "Y", "Z"),
        help="of the mirror plane, world axes",
    )  # fmt: skip
    group.add_argument(
        "--symmetry-offset", type=float, metavar="D",
        help="of the mirror plane along its normal, world units (the coarse mesh decides)",
    )  # fmt: skip
    group.add_argument(
        "--topology", choices=list(Topology), metavar="WHICH",
        help="open: faces over the silhouette's background go; fixed: none do (open, with a texture fixed)",
    )  # fmt: skip
    group.add_argument(
        "--correct-camera", action="store_true", default=None, help="the camera is a few degrees off"
    )
    group.add_argument(
        "--subdivide",
        action="store_true",
        default=None,
        help="split long edges of a mesh of few vertices",
    )
    group.add_argument(
        "--silhouette-threshold", type=float, metavar="T",
        help=f"where soft edges begin, between the image's levels ({_default('silhouette_threshold')})",
    )  # fmt: skip
    group.add_argument(
        "--ignore-grey", type=int, metavar="LEVEL", help="pixels of this level are unknown, e.g. 128 (none)"
    )
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
