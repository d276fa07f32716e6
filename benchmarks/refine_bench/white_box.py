"""The white-box baseline: the network's own latent code, fine-tuned through the renderer (MeshSDF).

MeshSDF (Remelli et al. 2020, arXiv 2006.03997) reads the mesh of a field off by marching cubes, which has no
gradient, and lets a vertex move along the normal as the field at its place changes: a change df moves the
level set outwards by df / |grad f|. So the silhouette loss at the input camera reaches the latent code, and
the mesh stays one that the network can make. This needs the network, its weights and its input; REFINE needs
the mesh.
"""

from __future__ import annotations

import time
from dataclasses import replace

import torch
import torch.nn.functional as F
from torch import Tensor

from refine_engine.cameras.project import project, stack
from refine_engine.kernels import optical_depth
from refine_engine.method.losses import silhouette
from refine_engine.values import Mesh

from .cases import Case, CaseSkipped, Scene
from .outcome import Outcome
from .sets.upstream import network
from .upstream.network import GRID, HALF_SIDE, Reconstruction
from .upstream.photos import Photo, sight_of
from .upstream.reconstruct import surface

ITERATIONS = 100
LEARNING_RATE = 0.05  # of Adam, on the latent code
PRIOR = 0.1  # weight of the squared distance from the first code, over its squared length; less overfits
RENDER_SIDE, SOFTNESS = 224, 3e-5  # pixels; squared normalised device units
LEAST_SLOPE = 2.0  # logits per unit of length: where the field is flat the level set has no place to move to


def white_box(case: Case, scene: Scene, seed: int) -> Outcome:
    """The mesh of the fine-tuned code; CaseSkipped where the network is not ours. Nothing in it is random."""
    if scene.image is None or scene.network is None:
        raise CaseSkipped(
            "expected a network of ours and the image that it saw, which this set does not have"
        )
    started = time.monotonic()
    photo = Photo(scene.image, scene.view.silhouette.numpy() > 0.5, scene.view.camera)
    mesh, curve = fine_tune(network(scene.network), photo)
    return Outcome(mesh, time.monotonic() - started, loss_curve=curve)


def fine_tune(
    network: Reconstruction, photo: Photo, iterations: int = ITERATIONS
) -> tuple[Mesh, tuple[float, ...]]:
    """The mesh of the lowest loss, and the loss per iteration."""
    with torch.no_grad():
        code = network.encode(sight_of(photo))
    first = code.latent
    latent = first.clone().requires_grad_()
    optimiser = torch.optim.Adam([latent], LEARNING_RATE)
    target = _target(photo)
    matrix, intrinsics = stack([photo.camera], first.device)
    intrinsics = intrinsics * (RENDER_SIDE / photo.camera.width)
    curve: list[float] = []
    best = latent.detach().clone()
    for _ in range(iterations):
        logits = network.decode(replace(code, latent=latent))[0]
        mesh = surface(logits.detach(), triangles=None)
        screen = project(_follow(mesh.vertices, logits), matrix, intrinsics)
        depth = optical_depth(screen, mesh.faces, RENDER_SIDE, SOFTNESS)
        prior = (latent - first).square().sum() / first.square().sum()
        loss = silhouette(depth, target, torch.ones_like(target)) + PRIOR * prior
        curve.append(float(loss.detach()))
        if curve[-1] == min(curve):
            best = latent.detach().clone()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    with torch.no_grad():
        return surface(network.decode(replace(code, latent=best))[0]), tuple(curve)


def _follow(vertices: Tensor, logits: Tensor) -> Tensor:
    """The vertices (V, 3) of the level set, unchanged in value; they move outwards as the logits grow."""
    places = vertices / HALF_SIDE
    with torch.no_grad():
        slopes = torch.stack(torch.gradient(logits.detach(), spacing=2 * HALF_SIDE / GRID))
        gradient = _sample(slopes, places).T  # (V, 3), inwards
        slope = gradient.norm(dim=1, keepdim=True)
        outward: Tensor = -gradient / slope.clamp_min(1e-9) / slope.clamp_min(LEAST_SLOPE)
    field = _sample(logits[None], places)[0, :, None]
    return vertices + outward * (field - field.detach())


def _sample(grids: Tensor, places: Tensor) -> Tensor:
    """(C, V): grids (C, X, Y, Z), whose values stand at the middles of the cells of [-1, 1]^3, at (V, 3)."""
    where = places.flip(1)[None, None, None]  # the last axis is the first coordinate
    values: Tensor = F.grid_sample(grids[None], where, padding_mode="border", align_corners=False)
    return values.reshape(len(grids), -1)


def _target(photo: Photo) -> Tensor:
    """(1, N, N) coverage of the silhouette at RENDER_SIDE."""
    given = torch.from_numpy(photo.silhouette).float()[None, None]
    smaller: Tensor = F.interpolate(given, (RENDER_SIDE, RENDER_SIDE), mode="area")
    return smaller[0]
