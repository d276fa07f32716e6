"""How the network's input, what the encoder sees at each vertex, comes about in each iteration."""

from __future__ import annotations

from collections.abc import Callable

from torch import Tensor

from .distinct_patches import DistinctPatches
from .network import Refiner

WORTHWHILE_SHARE = 0.8  # of distinct patches: objects have 0.4 to 0.7, a mask of noise 1, at twice the cost


def features_of(network: Refiner, silhouette: Tensor, grid: Tensor, train: bool) -> Callable[[], Tensor]:
    """A function that gives (V, 192) from the encoder's weights as they are when it is called.

    silhouette (1, 1, N, N); grid (1, 1, V, 2) as in `Refiner.features`. An encoder that is not trained
    is asked once; one that is trained on a CPU, if enough patches are alike, once per distinct patch.
    """
    if not train:
        network.encoder.requires_grad_(False)
        constant = network.features(silhouette, grid)
        return lambda: constant
    if not silhouette.is_cuda:
        distinct = DistinctPatches(silhouette, grid)
        if distinct.share < WORTHWHILE_SHARE:
            return lambda: distinct.features(network.encoder)
    return lambda: network.features(silhouette, grid)
