r"""Trains only the inlier weights of `compact`, before or between runs of `train`.

    python -m model_zoo_defs.training.learning.train_inliers --data DIR --start WEIGHTS \
        --out WEIGHTS

The statistics of the points have no parameters, so they are computed once for a few thousand
samples; the trained part is a small network on rows of statistics.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from numpy.random import Generator
from safetensors.torch import load_file
from torch import Tensor
from tqdm import tqdm

from model_zoo_defs._compact.inliers import InlierWeights, PointScore
from model_zoo_defs._compact.points import Points, Prior
from model_zoo_defs.compact import Compact
from model_zoo_defs.training.learning import priors
from model_zoo_defs.training.learning.dataset import Frames
from model_zoo_defs.training.learning.learner import export
from model_zoo_defs.training.learning.patterns import draw, outliers
from model_zoo_defs.training.learning.train import INLIER_ERROR, OUTLIER_ERROR, upgrade

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


class Table(NamedTuple):
    """Statistics of n points of two passes, the log odds of the first, and targets 0..1 (n,)."""

    first: tuple[Tensor, Tensor]
    second: tuple[Tensor, Tensor]
    log_odds: Tensor
    target: Tensor


@torch.no_grad()
def table(layer: InlierWeights, frames: Frames, count: int, seed: int) -> Table:
    """The table of `count` samples, at most POINTS_PER_SAMPLE points of each.

    The second pass uses the current weights of the first.
    """
    parts: list[list[Tensor]] = []
    for number in tqdm(range(count), unit="sample", mininterval=5.0):
        rng = np.random.default_rng((seed, number))
        sparse, ground_truth, dense = sample(rng, frames)
        points = Points(sparse)
        prior = Prior(dense, points)
        first = layer.statistics(points, prior, points.mask)
        log_odds = layer.first(*first)
        at = sparse > 0
        use = torch.zeros_like(sparse).masked_scatter(at, torch.sigmoid(log_odds))
        second = layer.statistics(points, prior, use)
        error = (torch.log(sparse[at]) - torch.log(ground_truth[at])).abs()
        target = ((OUTLIER_ERROR - error) / (OUTLIER_ERROR - INLIER_ERROR)).clamp(0.0, 1.0)
        known = torch.nonzero(ground_truth[at] > 0).squeeze(1).numpy()
        chosen = torch.from_numpy(rng.permutation(known)[:POINTS_PER_SAMPLE])
        columns = [first[0], first[1], second[0], second[1], log_odds, target]
        parts.append([column[chosen] for column in columns if column is not None])
    a, b, c, d, log_odds, target = (torch.cat(column) for column in zip(*parts, strict=True))
    return Table((a, b), (c, d), log_odds, target)


def fit(score: PointScore, rows: tuple[Tensor, Tensor], offset: Tensor, target: Tensor,
        steps: int) -> float:  # fmt: skip
    """Trains one pass on its statistics; its log odds are added to `offset` (n,).

    Returns:
        The running mean of the cross entropy at the end.
    """
    optimiser = torch.optim.AdamW(score.parameters(), lr=RATE, weight_decay=1e-4)
    generator = torch.Generator().manual_seed(0)
    smooth = 0.0
    for step in tqdm(range(steps), unit="step", mininterval=5.0):
        for group in optimiser.param_groups:
            group["lr"] = RATE * 0.5 * (1.0 + math.cos(math.pi * step / steps))
        chosen = torch.randint(len(target), (BATCH,), generator=generator)
        log_odds = offset[chosen] + score(rows[0][chosen], rows[1][chosen])
        loss = F.binary_cross_entropy_with_logits(log_odds, target[chosen])
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
    parser.add_argument("--second-only", action="store_true", help="keep the first pass")
    options = parser.parse_args()
    torch.manual_seed(options.seed)
    network = Compact()
    upgrade(network, load_file(options.start))
    layer, frames = network.inlier_weights, Frames(*options.data)
    if not options.second_only:
        data = table(layer, frames, options.samples, options.seed)
        nothing = torch.zeros_like(data.target)
        loss = fit(layer.first, data.first, nothing, data.target, options.steps)
        print(f"first pass: {len(data.target)} points, cross entropy {loss:.4f}")
    data = table(layer, frames, options.samples, options.seed + 1)
    loss = fit(layer.second, data.second, data.log_odds, data.target, options.steps)
    print(f"second pass: {len(data.target)} points, cross entropy {loss:.4f}")
    export(network, options.out)


if __name__ == "__main__":
    main()
