"""An optimisation's numbers as the Progress that watchers see."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping

from .models import Progress

_FORMER = 0.7  # how much of the pace so far counts beside the newest


class ProgressMeter:
    """Adds percent and the time that is left; lets only finite numbers through."""

    def __init__(self) -> None:
        self._last: tuple[int, float] | None = None  # iteration, time
        self._pace_s: float | None = None  # of an iteration

    def read(
        self, iteration: int, total: int, losses: Mapping[str, float], silhouette_iou: float
    ) -> Progress:
        """The Progress after `iteration`, at this moment."""
        self._measure(iteration)
        left = total - iteration
        return Progress(
            iteration=iteration,
            total=total,
            percent=round(100 * iteration / total, 1),
            eta_s=None if self._pace_s is None else round(self._pace_s * left, 1),
            losses={name: value for name, value in losses.items() if math.isfinite(value)},
            # Where neither covers a pixel it is 0 / 0: what is empty overlaps with nothing.
            silhouette_iou=silhouette_iou if math.isfinite(silhouette_iou) else 0.0,
        )

    def _measure(self, iteration: int) -> None:
        """A mean that follows: iterations of a later, finer stage take longer than the first ones."""
        now = time.monotonic()
        if self._last is not None and iteration > self._last[0]:
            pace_s = (now - self._last[1]) / (iteration - self._last[0])
            former_s = pace_s if self._pace_s is None else self._pace_s
            self._pace_s = _FORMER * former_s + (1 - _FORMER) * pace_s
        self._last = (iteration, now)
