"""The encoder on distinct patches against its twin, the encoder on every pixel."""

from collections.abc import Iterator

import pytest
import torch
from torch import Tensor

from refine_engine.method.distinct_patches import Classes, DistinctPatches
from refine_engine.method.network import Refiner, initialise

SIDE = 64


def disc() -> Tensor:
    """Touches the right border; hard."""
    y, x = torch.meshgrid(torch.arange(SIDE), torch.arange(SIDE), indexing="ij")
    return ((x - 45).square() + (y - 30).square() < 21**2).double()


def soft_disc() -> Tensor:
    """With grey values along the outline, as after a change of size."""
    return torch.nn.functional.avg_pool2d(disc()[None], 3, 1, 1)[0]


def noise() -> Tensor:
    """No two patches are equal."""
    return torch.rand(SIDE, SIDE, generator=torch.Generator().manual_seed(0), dtype=torch.float64)


@pytest.fixture
def network() -> Iterator[Refiner]:
    """In double precision, so that no rounding decides about a ReLU."""
    torch.set_default_dtype(torch.float64)
    network = Refiner()
    initialise(network, 6.0, torch.Generator().manual_seed(0))
    random = torch.Generator().manual_seed(1)
    for name, parameter in network.named_parameters():
        if "norm" in name or "stem.1" in name:  # as after some training
            parameter.data += 0.3 * torch.randn(parameter.shape, generator=random)
    yield network
    torch.set_default_dtype(torch.float32)


@pytest.mark.parametrize(
    "image", [disc(), soft_disc(), noise(), torch.zeros(SIDE, SIDE, dtype=torch.float64)]
)
def test_features_and_gradients_are_those_of_every_pixel(network: Refiner, image: Tensor) -> None:
    """On the object, beside it and beside the image."""
    random = torch.Generator().manual_seed(2)
    grid = 2.4 * torch.rand(1, 1, 300, 2, generator=random, dtype=torch.float64) - 1.2
    silhouette = image[None, None]
    expected = network.features(silhouette, grid)
    distinct = DistinctPatches(silhouette, grid)
    features = distinct.features(network.encoder)
    torch.testing.assert_close(features, expected)

    upstream = torch.randn(expected.shape, generator=random, dtype=torch.float64)
    weights = list(network.encoder.parameters())
    for ours, theirs in zip(
        torch.autograd.grad(features, weights, upstream),
        torch.autograd.grad(expected, weights, upstream),
        strict=True,
    ):
        torch.testing.assert_close(ours, theirs, rtol=1e-6, atol=1e-6 * float(theirs.abs().max()) + 1e-9)


def test_a_silhouette_has_few_patches() -> None:
    distinct = DistinctPatches(disc()[None, None], torch.zeros(1, 1, 1, 2, dtype=torch.float64))
    assert len(distinct.stem) < 0.3 * (SIDE / 2) ** 2
    everywhere = DistinctPatches(noise()[None, None], torch.zeros(1, 1, 1, 2, dtype=torch.float64))
    assert everywhere.share == 1


def test_classes_of_a_small_image() -> None:
    """A 4 x 4 image of one class: nine 3 x 3 patches that differ in the padding that they see."""
    classes = Classes.of(torch.zeros(4, 4, dtype=torch.int64), 3, 1, 1)
    assert len(classes) == 9
    assert sorted((16 * classes.share[0]).tolist()) == [1, 1, 1, 1, 2, 2, 2, 2, 4]
    image = classes.image
    assert image[1, 1] == image[1, 2] == image[2, 1] == image[2, 2]
    assert len({int(image[0, 0]), int(image[0, 3]), int(image[3, 0]), int(image[3, 3])}) == 4
