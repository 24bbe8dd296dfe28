"""Trains the inlier weights of `compact` by themselves, before or between runs of `train`.

    python -m model_zoo_defs.training.train_inliers --data DIR --start WEIGHTS --out WEIGHTS

The statistics of the points have no parameters, so they are computed once for a few thousand
samples; what remains is a small network on rows of numbers.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from numpy.random import Generator
from safetensors.torch import load_file
from torch import Tensor
from tqdm import tqdm

from model_zoo_defs.compact import Compact, Points, Prior
from model_zoo_defs.training import priors
from model_zoo_defs.training.dataset import Frames
from model_zoo_defs.training.learner import export
from model_zoo_defs.training.patterns import draw, outliers
from model_zoo_defs.training.train import INLIER_ERROR, OUTLIER_ERROR, upgrade

BATCH, RATE, STEPS = 4096, 1e-2, 3000
POINTS_PER_SAMPLE = 256


def sample(rng: Generator, frames: Frames) -> tuple[Tensor, Tensor, Tensor]:
    """Points, ground truth and prior (1, 1, H, W) of a random frame at 1/2 or 1/3 resolution."""
    while True:
        rgb, depth = frames[int(rng.integers(len(frames)))]
        step = int(rng.integers(2, 4))
        grey = np.ascontiguousarray(rgb[::step, ::step, 1].astype(np.float32) / 255.0)
        depth = np.ascontiguousarray(depth[::step, ::step])
        sparse = draw(rng, depth, grey)
        if rng.random() < 0.5:
            sparse = outliers(rng, sparse, float(rng.uniform(0.0, 0.3)))
        if np.any((sparse > 0) & (depth > 0)):
            break
    other = frames[int(rng.integers(len(frames)))][1]
    prior = priors.draw(rng, depth, grey, sparse, other)
    maps = (sparse, depth, np.zeros_like(depth) if prior is None else prior)
    tensors = [torch.from_numpy(np.asarray(x, np.float32))[None, None] for x in maps]
    return tensors[0], tensors[1], tensors[2]


def rows(network: Compact, frames: Frames, count: int, seed: int) -> tuple[Tensor, Tensor, Tensor]:
    """Statistics (n, ...) of points and residuals against the prior, and how far they are inliers.

    At most POINTS_PER_SAMPLE points of each of `count` samples.
    """
    layer, table = network.inlier_weights, []
    for number in tqdm(range(count), unit="sample", mininterval=5.0):
        rng = np.random.default_rng((seed, number))
        sparse, truth, dense = sample(rng, frames)
        points = Points(sparse)
        plain, of_prior = layer.statistics(points, Prior(dense, points))
        assert of_prior is not None
        at = sparse > 0
        error = (torch.log(sparse[at]) - torch.log(truth[at])).abs()
        target = ((OUTLIER_ERROR - error) / (OUTLIER_ERROR - INLIER_ERROR)).clamp(0.0, 1.0)
        known = torch.nonzero(truth[at] > 0).squeeze(1).numpy()
        chosen = torch.from_numpy(rng.permutation(known)[:POINTS_PER_SAMPLE])
        table.append((plain[chosen], of_prior[chosen], target[chosen]))
    statistics, of_prior, targets = (torch.cat(parts) for parts in zip(*table, strict=True))
    return statistics, of_prior, targets


def train_inliers(network: Compact, table: tuple[Tensor, Tensor, Tensor], steps: int) -> float:
    """The inlier weights of the network are trained on a table of `rows`; returns the loss."""
    layer = network.inlier_weights
    optimiser = torch.optim.AdamW(layer.parameters(), lr=RATE, weight_decay=1e-4)
    generator = torch.Generator().manual_seed(0)
    smooth = 0.0
    for step in tqdm(range(steps), unit="step", mininterval=5.0):
        for group in optimiser.param_groups:
            group["lr"] = RATE * 0.5 * (1.0 + math.cos(math.pi * step / steps))
        chosen = torch.randint(len(table[0]), (BATCH,), generator=generator)
        plain, of_prior, target = (part[chosen] for part in table)
        loss = F.binary_cross_entropy_with_logits(layer.logits(plain, of_prior), target)
        optimiser.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimiser.step()
        smooth += (float(loss.detach()) - smooth) * max(0.01, 1.0 / (step + 1))
    return smooth


def main() -> None:
    """Reads the command line and trains."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--data", type=Path, required=True, nargs="+", help="folders of shards")
    parser.add_argument("--start", type=Path, required=True, help="weights of the network")
    parser.add_argument("--out", type=Path, required=True, help="file for the weights")
    parser.add_argument("--samples", type=int, default=4000)
    parser.add_argument("--steps", type=int, default=STEPS)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    torch.manual_seed(options.seed)
    network = Compact()
    upgrade(network, load_file(options.start))
    table = rows(network, Frames(*options.data), options.samples, options.seed)
    print(f"{len(table[0])} points, loss {train_inliers(network, table, options.steps):.4f}")
    export(network, options.out)


if __name__ == "__main__":
    main()
