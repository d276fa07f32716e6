"""The network: its size, its first output, its randomness."""

import math

import pytest
import torch
from torch import Tensor

from refine_engine.method.network import GraphConv, Refiner, initialise
from refine_engine.method.topology import Topology
from refine_engine.values import Mesh


def make_network(seed: int = 0, mean_degree: float = 6.0) -> Refiner:
    network = Refiner()
    initialise(network, mean_degree, torch.Generator().manual_seed(seed))
    return network


@pytest.fixture
def run(ball: Mesh) -> tuple[Refiner, Tensor, Mesh, Topology]:
    """A network and what it needs for the ball: the network, features (V, 192), mesh, topology."""
    network = make_network()
    silhouette = torch.zeros(1, 1, 64, 64)
    silhouette[:, :, 16:48, 10:40] = 1
    grid = ball.vertices[None, None, :, :2]
    return network, network.features(silhouette, grid), ball, Topology.of(ball.faces, len(ball.vertices))


def test_it_has_the_parameters_of_the_paper() -> None:
    assert 900_000 <= sum(p.numel() for p in Refiner().parameters()) <= 1_000_000


def test_the_first_iterate_is_the_coarse_mesh(run: tuple[Refiner, Tensor, Mesh, Topology]) -> None:
    network, features, ball, topology = run
    assert features.shape == (162, 192)
    offsets, confidence = network(features, ball.vertices, topology)
    assert offsets.shape == (162, 3)
    assert not offsets.any()
    assert confidence.shape == (162,)
    low, high = confidence.detach().aminmax()
    assert 0 <= float(low) < float(high) <= 1


def test_confidence_stays_in_range_far_out(run: tuple[Refiner, Tensor, Mesh, Topology]) -> None:
    network, features, ball, topology = run
    _, confidence = network(1e4 * features, ball.vertices, topology)
    low, high = confidence.detach().aminmax()
    assert 0 <= float(low) <= float(high) <= 1


def test_every_weight_can_learn(run: tuple[Refiner, Tensor, Mesh, Topology]) -> None:
    """After one step of the displacement head, whose zeros stop the gradient at first."""
    network, features, ball, topology = run
    with torch.no_grad():
        network.displacement.weight.normal_(generator=torch.Generator().manual_seed(1))
    offsets, confidence = network(features, ball.vertices, topology)
    (offsets.square().sum() + confidence.sum()).backward()
    silent = [name for name, p in network.named_parameters() if p.grad is None or not p.grad.any()]
    assert silent == []


def test_the_seed_decides_the_weights() -> None:
    torch.manual_seed(1)
    one = make_network(3).state_dict()
    torch.manual_seed(2)
    two, other = make_network(3).state_dict(), make_network(4).state_dict()
    assert all(torch.equal(one[name], two[name]) for name in one)
    assert not torch.equal(one["bottleneck.weight"], other["bottleneck.weight"])
    assert not torch.equal(one["encoder.stem.0.weight"], other["encoder.stem.0.weight"])


def test_activations_keep_their_size(ball: Mesh) -> None:
    """The point of `initialise`: eight convolutions neither blow up nor fade out."""
    topology = Topology.of(ball.faces, len(ball.vertices))
    network = make_network(mean_degree=float(topology.degree.mean()))
    x = torch.randn(162, 131, generator=torch.Generator().manual_seed(0))
    first = float(x.std())
    for conv in network.convs:
        x = torch.relu(conv(x, topology)).detach()
    assert first / 10 < float(x.square().mean().sqrt()) < first * 10


def test_graph_convolution_is_its_formula() -> None:
    """w0 x_v + sum over the neighbours u of w1 x_u + b, vertex by vertex; vertex 4 is alone."""
    random = torch.Generator().manual_seed(2)
    conv = GraphConv(3, 2)
    x = torch.randn(5, 3, generator=random)
    neighbours = {0: [1, 2, 3], 1: [0, 2], 2: [0, 1, 3], 3: [0, 2], 4: []}
    out = conv(x, Topology.of(torch.tensor([[0, 1, 2], [0, 2, 3]]), 5))
    weight, bias = conv.own_and_neighbour.weight, conv.own_and_neighbour.bias
    (w0, w1), (b0, b1) = weight.chunk(2), bias.chunk(2)
    for v, around in neighbours.items():
        expected = w0 @ x[v] + b0
        for u in around:
            expected = expected + w1 @ x[u] + b1
        torch.testing.assert_close(out[v], expected, atol=1e-6, rtol=1e-5)


def test_features_are_what_the_camera_sees_there() -> None:
    """On the object, beside it, on the object again, and beside the image."""
    silhouette = torch.zeros(1, 1, 64, 64)
    silhouette[:, :, :, :32] = 1
    grid = torch.tensor([[[[-0.5, 0.0], [0.5, 0.0], [-0.5, 0.0], [math.pi, 0.0]]]])
    features = make_network().features(silhouette, grid)
    assert not torch.allclose(features[0], features[1])
    assert torch.equal(features[0], features[2])
    assert bool(torch.isfinite(features).all())  # beside the image: the border's
