"""Every number of the method, with its unit and the paper's value.

Lengths are in units of the normalised mesh: the longest side of its bounding box is 1.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

from ..errors import OptionsInvalid

Symmetry = Literal["auto", "plane", "none"]
Topology = Literal["auto", "open", "fixed"]


@dataclass(frozen=True)
class Weights:
    """Weights of the losses, which are means over their elements (paper, section 4)."""

    silhouette: float = 10.0
    image_symmetry: float = 80.0
    vertex_symmetry: float = 20.0
    displacement: float = 100.0
    normal_consistency: float = 10.0
    laplacian: float = 10.0


@dataclass(frozen=True)
class Stage:
    """One stretch of the optimisation at one image size and one softness."""

    iterations: int
    render_size: int
    """Side of the square soft renders, pixels."""
    softness: float
    """Squared distance over which the silhouette fades, in normalised device units (image side = 2)."""


@dataclass(frozen=True)
class Opening:
    """Which faces are taken to be webs over holes, see `opening`; not in the paper."""

    share: float = 0.4
    """Of a face's area that must lie outside."""
    depth: float = 0.025
    """How deep into the background a region must reach, in sizes of the object's picture."""
    outline_px: float = 1.0
    """Pixels beside the outline that count as the object: masks are no better."""
    explained: float = 0.08
    """Difference d below which motion alone explains the silhouettes, and no faces are taken away before."""


@dataclass(frozen=True)
class ProportionFit:
    """The first step of the default: scales, shear, thickness and place of the whole mesh; not in the paper.

    See `proportions`. The priors weigh squares of unit-box lengths, of logarithms or of radians against
    evidence * ln(1 + d / noise), where d is the squared difference of the images relative to the object's
    area.
    """

    iterations: int = 60
    render_size: int = 160
    """Side of the square renders, pixels; at least 32, for the levels of the image pyramid."""
    softness: float = 1e-5
    """As in Stage; sharp, because the image pyramid reaches far and a soft outline is biased outwards."""
    learning_rate: float = 0.015
    evidence: float = 0.1
    """The logarithm's factor: a fit that leaves much of the difference weighs less against the priors."""
    noise: float = 0.1
    """The difference d below which more agreement is worth little."""
    scale_prior: float = 0.1
    """On the logarithms of the scales."""
    shear_prior: float = 0.2
    """On the shear in the mirror plane, which networks get wrong less often than a scale."""
    thickness_prior: float = 10.0
    """On the shift along the normals: a scale or a place explains most silhouettes as well."""
    translation_prior: float = 0.4
    """On the translation in the mirror plane."""
    depth_prior: float = 2.0
    """On the translation along the viewing direction, which one silhouette hardly sees."""
    plane_prior: float = 0.002
    """On the translation along the plane's normal, over the squared distance of mesh and mirror image."""
    camera_prior: float | None = None
    """On the rotation of the camera about the object, radians (1.0 suits a few degrees of error); None: the
    camera is exact."""


@dataclass(frozen=True)
class RefineConfig:
    """The numbers of one run. The defaults are the recommended preset; `paper()`, `fast()` the others."""

    proportions: ProportionFit | None = field(default_factory=ProportionFit)
    """The fit of the whole mesh before the network; None: no such step (paper)."""
    stages: tuple[Stage, ...] = (Stage(100, 224, 1e-5),)
    weights: Weights = field(
        default_factory=lambda: Weights(image_symmetry=0.0, displacement=300.0, normal_consistency=3.0)
    )
    """The paper's, without the image symmetry, whose twelve renders gain nothing beside the vertex symmetry,
    and with small steps: once the proportions are right, the rest is small."""
    confidence_cost: float = 0.0005
    """lambda_B: what it costs to call a place asymmetric."""
    learning_rate: float = 2e-4
    encoder_size: int = 112
    """Side of the silhouette that the encoder sees, pixels."""
    train_encoder: bool = False
    """False: the random features of the silhouette are computed once (paper: True)."""
    symmetry_azimuths_degrees: tuple[float, ...] = (15.0, 45.0, 75.0)
    symmetry_elevations_degrees: tuple[float, ...] = (-45.0, 45.0)
    symmetry_distance: float = 1.9
    symmetry_fov_degrees: float = 60.0
    symmetry: Symmetry = "auto"
    """auto: the mirror plane is found on the coarse mesh; plane: it has `symmetry_normal`; none: no terms."""
    symmetry_normal: tuple[float, float, float] = (0.0, 0.0, 1.0)
    """Normal of the given mirror plane, world frame."""
    symmetry_offset: float | None = None
    """The given plane is normal.x = offset, world units; None: where the mirrored mesh is nearest itself."""
    agreement: float | None = 0.9
    """2D IoU from which a coarse mesh agrees with its silhouettes and comes back as it was: what is left is
    the outline's own noise, and following it made more shapes worse than better. None: never (paper)."""
    learn_confidence: bool = False
    """Confidences from the network's head (paper: True), or those that minimise their losses."""
    opening: Opening = field(default_factory=Opening)
    """Which faces cover the silhouette's background, and are left out of the renders (paper: none)."""
    topology: Topology = "auto"
    """open: these faces are removed from the result; fixed: it has all faces of the coarse mesh; auto: open,
    but fixed for a file with a texture, where a hole would show."""
    crop: bool = True
    """Compare images of the object, not of the whole picture (paper: False)."""
    pyramid: bool = True
    """Compare the silhouettes over an image pyramid, not pixel by pixel by cross entropy (paper: False)."""
    unexplained_depth: float | None = 0.05
    """Sizes of the object: background pixels that the mesh covers by more do not pull at it; None: all do
    (paper)."""
    regularise_change: bool = True
    """Laplacian and folds of the change since the coarse mesh, not of the mesh itself (paper: False)."""
    seed: int = 0
    """Of the network's random weights."""

    def __post_init__(self) -> None:
        length = math.sqrt(sum(x * x for x in self.symmetry_normal))
        if not (math.isfinite(length) and length > 1e-6):
            raise OptionsInvalid(f"expected a symmetry_normal with a direction, got {self.symmetry_normal}")
        if self.symmetry_offset is not None and not math.isfinite(self.symmetry_offset):
            raise OptionsInvalid(f"expected a finite symmetry_offset, got {self.symmetry_offset}")
        if not self.stages or min(stage.iterations for stage in self.stages) < 1:
            raise OptionsInvalid(f"expected stages of at least one iteration, got {self.stages}")

    @property
    def iterations(self) -> int:
        """Iterations of all stages together."""
        return sum(stage.iterations for stage in self.stages)

    @staticmethod
    def paper() -> RefineConfig:
        """The published method, for comparison with the literature: plane through the world origin."""
        return RefineConfig(
            proportions=None,
            topology="fixed",
            agreement=None,
            learn_confidence=True,
            crop=False,
            regularise_change=False,
            pyramid=False,
            unexplained_depth=None,
            symmetry="plane",
            weights=Weights(),
            stages=(Stage(400, 224, 1e-4),),
            learning_rate=7e-5,
            encoder_size=224,
            train_encoder=True,
            symmetry_offset=0.0,
        )

    @staticmethod
    def fast() -> RefineConfig:
        """A quarter of the cost of `paper()` or less."""
        return RefineConfig(stages=(Stage(40, 224, 1e-5),), learning_rate=3e-4)
