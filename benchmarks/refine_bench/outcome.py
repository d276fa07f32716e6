"""What a method makes of a case."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from torch import Tensor

from refine_engine.values import Mesh, MirrorPlane

from .cases import Case, Scene


@dataclass(frozen=True)
class Outcome:
    """The refined mesh and what came with it."""

    mesh: Mesh
    seconds: float
    confidence: Tensor | None = None  # (V,)
    plane: MirrorPlane | None = None  # that the confidence is about
    loss_curve: Sequence[float] = ()
    queue_s: float | None = None  # waited for a slot; of a server only


Method = Callable[[Case, Scene, int], Outcome]  # the int is the seed
