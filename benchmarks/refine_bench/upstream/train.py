"""Trains a network: `python -m refine_bench.upstream.train camera` writes weights like those of this project.

Under half an hour on one core of an AMD EPYC: 3,150 objects in five images each, drawn here; a quarter of an
hour for those of `image`, which were made with `--objects 100 --steps 4000`. Rounding differs from processor
to processor, so every training gives another network, of the same quality.
"""

from __future__ import annotations

import argparse
import sys
import time
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits

from ..coarsen import occupancy
from .network import GRID, HALF_SIDE, KINDS, Kind, Reconstruction, Sight, save_weights, weights_of
from .photos import ASSEMBLY, KNOWN, make_object, sight_of, take_photo

OBJECTS, PHOTOS = 150, 5  # of each kind, of each object
OBJECT_KINDS = (*KNOWN, *[ASSEMBLY] * 8)  # two in five objects belong to no category
BATCH = 16
LEARNING_RATE = 2e-3
WARM_UP = 200  # steps
THIN_GAIN = 1.5  # of the coverage of a cell: thin parts are to be kept, so a network is tuned to swell them


@dataclass(frozen=True)
class Examples:
    """P photos of each of N objects, and the occupancy of the objects."""

    images: Tensor  # (N, P, 3, 64, 64) uint8
    poses: Tensor  # (N, P, 5)
    projections: Tensor  # (N, P, 3, 4)
    coverage: Tensor  # (N, 40, 40, 40) uint8, share of each cell inside, 255 is all

    def batch(self, rng: np.random.Generator) -> tuple[Sight, Tensor]:
        """Random photos of random objects, and their targets in [0, 1]."""
        count, photos = self.images.shape[:2]
        chosen = torch.from_numpy(rng.integers(count, size=BATCH))
        photo = torch.from_numpy(rng.integers(photos, size=BATCH))
        sight = Sight(
            self.images[chosen, photo].float() / 255.0,
            self.poses[chosen, photo],
            self.projections[chosen, photo],
        )
        return sight, (self.coverage[chosen].float() * (THIN_GAIN / 255.0)).clamp_max(1.0)


def make_examples(objects: int, photos: int) -> Examples:
    """Of `objects` objects of each of OBJECT_KINDS; always the same ones."""
    made = [
        _example(kind, f"train/{number}/{place}", photos)
        for number in range(objects)
        for place, kind in enumerate(OBJECT_KINDS)
    ]
    return Examples(*(torch.stack(column) for column in zip(*made, strict=True)))


def _example(kind: str, name: str, photos: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """One object, as in Examples."""
    shape = make_object(kind, name)
    rng = np.random.default_rng(zlib.crc32(f"{kind}/{name}".encode()))
    sights = [sight_of(take_photo(shape, rng, shifted=False)) for _ in range(photos)]
    share = occupancy(shape, np.full(3, -HALF_SIDE), 2 * HALF_SIDE / GRID, np.full(3, GRID))
    return (
        torch.cat([(sight.images * 255.0 + 0.5).byte() for sight in sights]),
        torch.cat([sight.poses for sight in sights]),
        torch.cat([sight.projections for sight in sights]),
        torch.from_numpy(np.asarray(share * 255 + 0.5, np.uint8)),
    )


def train(
    kind: Kind, examples: Examples, steps: int, seed: int = 0
) -> Iterator[tuple[int, float, Reconstruction]]:
    """Yields (step, loss, network) after every step; it is one and the same network, ready after the last."""
    torch.manual_seed(seed)
    rng = np.random.default_rng(seed)
    network = Reconstruction(kind)
    optimiser = torch.optim.AdamW(network.parameters(), LEARNING_RATE, weight_decay=1e-3)
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimiser, LEARNING_RATE, total_steps=steps, pct_start=min(0.3, WARM_UP / steps)
    )
    network.train()
    for step in range(steps):
        sight, targets = examples.batch(rng)
        with torch.autocast("cpu", torch.bfloat16):
            logits = network(sight)
        loss = binary_cross_entropy_with_logits(logits.float(), targets)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
        yield step, float(loss.detach()), network


def main(argv: list[str]) -> None:
    parser = argparse.ArgumentParser(prog="python -m refine_bench.upstream.train", description=__doc__)
    parser.add_argument("kind", choices=KINDS, help="what it knows: the image alone, or the camera as well")
    parser.add_argument("-o", "--output", type=Path, metavar="FILE", help="(in place of this project's own)")
    parser.add_argument("--objects", type=int, default=OBJECTS, metavar="N", help="per kind (%(default)s)")
    parser.add_argument("--steps", type=int, default=5_000, metavar="N", help="(%(default)s)")
    parser.add_argument("--threads", type=int, default=1, metavar="N")
    options = parser.parse_args(argv)
    torch.set_num_threads(options.threads)
    started = time.monotonic()
    examples = make_examples(options.objects, PHOTOS)
    print(f"{len(examples.images)} objects in {time.monotonic() - started:.0f} s", flush=True)
    mean = 0.0
    for step, loss, network in train(options.kind, examples, options.steps):
        mean = loss if step == 0 else 0.99 * mean + 0.01 * loss
        if (step + 1) % 250 == 0 or step + 1 == options.steps:
            print(f"{step + 1} {mean:.5f} {time.monotonic() - started:.0f} s", flush=True)
            save_weights(network, options.output or weights_of(options.kind))


if __name__ == "__main__":
    main(sys.argv[1:])
