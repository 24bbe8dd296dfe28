r"""Trains only the inlier weights of `compact`, before or between runs of `train`.

    python -m model_zoo_defs.training.learning.train_inliers --data DIR --start WEIGHTS \
        --out WEIGHTS

The trained part sees the points and their colours: the clouds of some thousand samples are drawn
once, then it is trained on them for a few epochs, from its weights in `--start`.
"""

from __future__ import annotations

import argparse
import copy
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from safetensors.torch import load_file
from torch import Tensor
from torch.utils.data import DataLoader, Dataset
from tqdm import tqdm

from model_zoo_defs._compact.cloud import Cloud
from model_zoo_defs._compact.inliers import InlierWeights
from model_zoo_defs._compact.points import Points
from model_zoo_defs.compact import Compact
from model_zoo_defs.training.learning.dataset import Samples
from model_zoo_defs.training.learning.learner import Schedule, export, follow
from model_zoo_defs.training.learning.patterns import outliers, wrong_tracks

# Samples in a step.
BATCH = 4
# Learning rate after the warm-up.
RATE = 1.5e-3
# Steps of a run, unless the command line says otherwise.
STEPS = 12_000
# Rows and columns of a sample's image.
WINDOW = (384, 512)
# A strip of the image with so many points is enough of a sample.
MOST_POINTS = 3000
# Fraction of the samples that outliers are added to, and most of their fraction there.
OUTLIERS_IN = 0.6
MOST_OUTLIERS = 0.35
# Fraction of the samples with outliers whose outliers are wrong tracks.
TRACKS_IN = 0.25
# Fractions of all samples: the image is moved away from the points; it shows little or nothing.
MOVED_IN = 0.15
FLAT_IN = 0.25
# |error of log depth| below which a point is an inlier, and above which it is an outlier.
INLIER_ERROR = 0.05
OUTLIER_ERROR = 0.2


class Example(NamedTuple):
    """Points of one image and how far each is an inlier (n,), 0..1; nan = unknown."""

    cloud: Cloud
    target: Tensor


class Examples(Dataset[Example]):
    """Clouds of augmented samples; outliers are added to most of them."""

    def __init__(self, folders: tuple[Path, ...], count: int, seed: int):
        self.samples = Samples(folders, WINDOW, seed, prior_fraction=0.0)
        self.count = count
        self.seed = seed

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, index: int) -> Example:
        """Returns an example, the same for the same index and seed."""
        rng = np.random.default_rng((self.seed, index, 1))
        sample = self.samples[index]
        sparse = sample.sparse[0].numpy()
        if rng.random() < OUTLIERS_IN:
            spoiled = wrong_tracks if rng.random() < TRACKS_IN else outliers
            sparse = spoiled(rng, sparse, float(rng.uniform(0.0, MOST_OUTLIERS)))
        drawn = example(torch.from_numpy(sparse), sample.depth[0], sample.rgb, rng.random())
        drawn = moved(rng, drawn) if rng.random() < MOVED_IN else drawn
        return flattened(rng, drawn) if rng.random() < FLAT_IN else drawn


def example(sparse: Tensor, ground_truth: Tensor, rgb: Tensor, where: float) -> Example:
    """The points of a strip of rows as an example.

    Args:
        sparse: Points (H, W) in metres, 0 = unknown.
        ground_truth: Depth (H, W) in metres, 0 = unknown.
        rgb: The normalised image (3, H, W).
        where: Position of the strip, 0 (top) to 1 (bottom), of images with more than MOST_POINTS.
    """
    value = Points(sparse[None, None]).value[0, 0]
    rows = torch.nonzero(sparse > 0)[:, 0]
    if len(rows) > MOST_POINTS:
        first = int(where * (len(rows) - MOST_POINTS))
        strip = slice(int(rows[first]), int(rows[first + MOST_POINTS - 1]) + 1)
        sparse = sparse[strip]
        value = value[strip]
        ground_truth = ground_truth[strip]
        rgb = rgb[:, strip]
    at = sparse > 0
    cloud = Cloud.of_image(at, value, rgb)
    return Example(cloud, inlier_targets(sparse[at], ground_truth[at]))


def moved(rng: np.random.Generator, of: Example) -> Example:
    """The example with the colours of points elsewhere: those of a row above or below."""
    count = len(of.target)
    by = int(rng.integers(count // 20, count // 2 + 1)) * int(rng.choice((-1, 1)))
    return of._replace(cloud=of.cloud._replace(colour=of.cloud.colour.roll(by, 0)))


def flattened(rng: np.random.Generator, of: Example) -> Example:
    """The example with at most a quarter of the differences of colour, every second time none."""
    contrast = float(rng.uniform(0.0, 0.25)) * int(rng.integers(2))
    mean = of.cloud.colour.mean(0)
    return of._replace(cloud=of.cloud._replace(colour=mean + contrast * (of.cloud.colour - mean)))


def inlier_targets(sparse: Tensor, ground_truth: Tensor) -> Tensor:
    """How far points (n,) are inliers, 0..1; nan where the ground truth is unknown."""
    error = (torch.log(sparse) - torch.log(ground_truth)).abs()
    target = ((OUTLIER_ERROR - error) / (OUTLIER_ERROR - INLIER_ERROR)).clamp(0.0, 1.0)
    return torch.where(ground_truth > 0, target, torch.nan)


def loss_of(layer: InlierWeights, examples: Sequence[Example]) -> Tensor:
    """Mean over the examples of the mean cross entropy of their points."""
    cloud = Cloud.joined([example.cloud for example in examples])
    log_odds = layer.log_odds(cloud)
    total = log_odds.new_zeros(())
    per_example = torch.split(log_odds, list(cloud.counts))
    for logits, (_, target) in zip(per_example, examples, strict=True):
        known = ~target.isnan()
        if bool(known.any()):
            total = total + F.binary_cross_entropy_with_logits(logits[known], target[known])
    return total / len(examples)


def fit(layer: InlierWeights, examples: Sequence[Example], steps: int, seed: int) -> float:
    """Trains the layer; it ends with the running average of its weights.

    Returns:
        The running mean of the cross entropy at the end.
    """
    optimiser = torch.optim.AdamW(layer.parameters(), lr=RATE, weight_decay=1e-3)
    average = copy.deepcopy(layer)
    schedule = Schedule(lr=RATE, steps=steps, warm_up=100)
    rng = np.random.default_rng(seed)
    smooth = 0.0
    for step in tqdm(range(steps), unit="step", mininterval=5.0):
        for group in optimiser.param_groups:
            group["lr"] = schedule.rate(step, 0.0)
        loss = loss_of(layer, [examples[int(i)] for i in rng.integers(len(examples), size=BATCH)])
        optimiser.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        torch.nn.utils.clip_grad_norm_(layer.parameters(), 1.0)
        optimiser.step()
        follow(average, layer, step + 1, schedule.averaging)
        smooth += (float(loss.detach()) - smooth) * max(0.005, 1.0 / (step + 1))
    layer.load_state_dict(average.state_dict())
    return smooth


def _first(batch: list[Example]) -> Example:
    """Returns the only example of a loader's batch of one."""
    return batch[0]


def drawn(folders: tuple[Path, ...], count: int, seed: int, workers: int) -> list[Example]:
    """The examples of all samples."""
    loader = DataLoader(
        Examples(folders, count, seed), batch_size=1, collate_fn=_first, num_workers=workers
    )
    return list(tqdm(loader, unit="sample", mininterval=5.0))


def main() -> None:
    """Reads the command line and trains."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--data", type=Path, required=True, nargs="+", help="folders of shards")
    parser.add_argument("--val", type=Path, help="folder of shards kept for validation")
    parser.add_argument("--start", type=Path, required=True, help="weights of the network")
    parser.add_argument("--out", type=Path, required=True, help="file for the weights")
    parser.add_argument("--samples", type=int, default=50_000)
    parser.add_argument("--steps", type=int, default=STEPS)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--workers", type=int, default=0)
    options = parser.parse_args()
    torch.manual_seed(options.seed)
    network = Compact()
    network.load_state_dict(load_file(options.start))
    examples = drawn(tuple(options.data), options.samples, options.seed, options.workers)
    loss = fit(network.inlier_weights, examples, options.steps, options.seed)
    print(f"{len(examples)} samples, cross entropy {loss:.4f}")
    export(network, options.out)
    if options.val:
        held_out = drawn((options.val,), 300, options.seed + 1, options.workers)
        with torch.no_grad():
            losses = [float(loss_of(network.inlier_weights, [example])) for example in held_out]
        print(f"{len(losses)} samples not trained on, cross entropy {np.mean(losses):.4f}")


if __name__ == "__main__":
    main()
