"""Dense priors for training: ground truth with the errors of depth networks, and unrelated depth.

`draw` returns a prior (H, W) in metres, aligned to the points as the program aligns a prediction,
0 where unknown; None for a sample without prior. The same generator state gives the same prior.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
import torch.nn.functional as F
from numpy.random import Generator
from numpy.typing import NDArray
from torch import Tensor

from model_zoo_defs.training.learning.patterns import window

Depth = NDArray[np.float32]

# Fraction of the samples that have a prior, and of these the ones whose prior is unrelated depth.
PRIOR_FRACTION = 0.55
NONSENSE_FRACTION = 0.3


def draw(
    rng: Generator,
    depth: Depth,
    grey: Depth,
    sparse: Depth,
    other: Depth,
    fraction: float = PRIOR_FRACTION,
) -> Depth | None:
    """Returns a prior of a random kind, aligned to the points; None for some samples.

    Args:
        rng: Random numbers.
        depth: Ground truth (H, W) in metres, 0 = unknown.
        grey: The image (H, W) 0..1.
        sparse: Points (H, W) in metres, 0 = unknown.
        other: Depth of an unrelated frame, of any size.
        fraction: Probability that there is one.
    """
    if rng.random() >= fraction:
        return None
    is_useless = rng.random() < NONSENSE_FRACTION
    raw = nonsense(rng, depth.shape, other) if is_useless else damaged(rng, depth, grey)
    prior = aligned(raw, sparse, affine=bool(rng.random() < 0.4))
    if rng.random() < 0.1:
        prior = np.where(window(rng, depth.shape), np.float32(0.0), prior)
    return prior


def aligned(prior: Depth, sparse: Depth, *, affine: bool) -> Depth:
    """Returns the prior scaled to the points by the median ratio, or fitted in log depth.

    The fit minimises the absolute residuals by reweighting; its slope stays in 0.3..3.

    Args:
        prior: (H, W), 0 = unknown.
        sparse: Points (H, W) in metres, 0 = unknown.
        affine: Whether slope and offset of log depth are fitted.
    """
    both = (sparse > 0) & (prior > 0)
    if not both.any():
        return prior
    log_points = np.log(sparse[both])
    log_at_points = np.log(prior[both])
    slope = 1.0
    offset = float(np.median(log_points - log_at_points))
    if affine and len(log_points) >= 5:
        for _ in range(5):
            residual = slope * log_at_points + offset - log_points
            weight = 1.0 / np.maximum(np.abs(residual), 0.02)
            weight /= weight.sum()
            mean_at_points = float(weight @ log_at_points)
            mean_points = float(weight @ log_points)
            centred = log_at_points - mean_at_points
            variance = float(weight @ centred**2) + 1e-4
            covariance = weight @ (centred * (log_points - mean_points))
            slope = float(np.clip(covariance / variance, 0.3, 3.0))
            offset = mean_points - slope * mean_at_points
    log_prior = np.log(np.where(prior > 0, prior, 1.0))
    fitted = np.exp(np.clip(slope * log_prior + offset, -12.0, 12.0))
    return np.where(prior > 0, fitted, 0.0).astype(np.float32)


def filled(depth: Depth) -> Tensor:
    """Returns log depth (1, 1, H, W) with unknown pixels filled from coarser and coarser means.

    Args:
        depth: (H, W) in metres, 0 = unknown.
    """
    # Levels of half the size each: mean of known log depth, 0 where unknown, and known fraction.
    known = torch.from_numpy((depth > 0).astype(np.float32))[None, None]
    value = torch.from_numpy(np.log(np.where(depth > 0, depth, 1.0)).astype(np.float32))[None, None]
    levels = [(value * known, known)]
    while min(levels[-1][0].shape[-2:]) > 1:
        total, fraction = (F.avg_pool2d(level, 2, ceil_mode=True) for level in levels[-1])
        levels.append((total, fraction))
    # From the coarsest level on, each fills what the finer one lacks.
    result = levels[-1][0] / levels[-1][1].clamp(min=1e-6)
    for total, fraction in reversed(levels[:-1]):
        coarse = _enlarged(result, total.shape[-2:])
        result = torch.where(fraction > 0, total / fraction.clamp(min=1e-6), coarse)
    return result


def damaged(rng: Generator, depth: Depth, grey: Depth) -> Depth:
    """Returns ground truth (H, W) with random errors of depth networks, up to scale.

    `grey` (H, W) 0..1 is the image, whose texture may shine through. One severity per prior scales
    all errors: some priors are nearly exact, others poor throughout.
    """
    severity = float(rng.uniform(0.05, 1.0) ** 1.5)
    log_depth = filled(depth)
    chance = 0.25 + 0.5 * severity
    for fault in FAULTS:
        if rng.random() < chance:
            log_depth = fault(rng, log_depth, severity)
    if rng.random() < 0.4 * chance:
        texture = torch.from_numpy(grey)[None, None]
        texture = texture - _smooth(texture, 8)
        log_depth = log_depth + float(rng.normal(0.0, 0.3 * severity)) * texture
    return np.asarray(torch.exp(log_depth.clamp(-10.0, 10.0))[0, 0].numpy(), dtype=np.float32)


def nonsense(rng: Generator, shape: tuple[int, ...], other: Depth) -> Depth:
    """Returns a dense depth (shape) unrelated to the sample: constant, noise or that of `other`."""
    kind = rng.integers(4)
    if kind == 0:
        return np.ones(shape, np.float32)
    if kind == 1:
        grid = rng.normal(0.0, rng.uniform(0.1, 1.0), (1, 1, *rng.integers(3, 40, 2)))
        noise = _enlarged(torch.from_numpy(grid).float(), shape)
        return np.asarray(torch.exp(noise)[0, 0].numpy(), dtype=np.float32)
    if kind == 2:
        rough = rng.normal(0.0, rng.uniform(0.05, 0.5), shape)
        return np.asarray(np.exp(rough), dtype=np.float32)
    unrelated = torch.exp(filled(other))
    return np.asarray(_enlarged(unrelated, shape)[0, 0].numpy(), dtype=np.float32)


def _lost_details(rng: Generator, x: Tensor, severity: float) -> Tensor:
    """Returns log depth x (1, 1, H, W) without thin near objects, or thin gaps between them."""
    reach = 2 * int(rng.integers(1, 2 + round(4 * severity))) + 1
    sign = 1.0 if rng.random() < 0.75 else -1.0
    # A morphological closing of depth, of its negative an opening.
    grown = F.max_pool2d(sign * x, reach, 1, reach // 2)
    return sign * -F.max_pool2d(-grown, reach, 1, reach // 2)


def _blurred(rng: Generator, x: Tensor, severity: float) -> Tensor:
    """Returns log depth x (1, 1, H, W) at 1/2 to 1/16 of the resolution, enlarged again."""
    factor = 2 ** int(rng.integers(1, 3 + round(2 * severity)))
    if rng.random() < 0.3:
        return _enlarged(x[..., factor // 2 :: factor, factor // 2 :: factor], x.shape[-2:])
    return _smooth(x, factor)


def _displaced(rng: Generator, x: Tensor, severity: float) -> Tensor:
    """Returns log depth x (1, 1, H, W) moved by a smooth field of a few pixels."""
    height, width = x.shape[-2:]
    pixels = float(rng.uniform(0.5, 1.0 + 6.0 * severity))
    flow = _field(rng, x, int(rng.integers(3, 12)), channels=2)[0] * pixels
    identity = F.affine_grid(torch.eye(2, 3)[None], [1, 1, height, width], align_corners=False)
    scaled = torch.stack([flow[0] * 2.0 / width, flow[1] * 2.0 / height], -1)
    return F.grid_sample(x, identity + scaled, padding_mode="border", align_corners=False)


def _scale_field(rng: Generator, x: Tensor, severity: float) -> Tensor:
    """Returns log depth x (1, 1, H, W) with a smoothly varying error of scale."""
    return x + _field(rng, x, int(rng.integers(2, 9))) * float(rng.uniform(0.02, 0.3) * severity)


def _contrast(rng: Generator, x: Tensor, severity: float) -> Tensor:
    """Returns log depth x (1, 1, H, W) of depth that is raised to a random power."""
    middle = x.mean()
    return middle + (x - middle) * float(np.exp(rng.normal(0.0, 0.35 * severity)))


def _affine(rng: Generator, x: Tensor, severity: float) -> Tensor:
    """Returns log depth x (1, 1, H, W) after an offset of depth, or of inverse depth.

    The offset is relative to the smallest value of either.
    """
    sign = 1.0 if rng.random() < 0.5 else -1.0
    linear = torch.exp(sign * (x - x.median()).clamp(-4.0, 4.0))
    ratio = float(rng.uniform(-0.7, 1.0) * severity)
    return sign * torch.log((linear + ratio * linear.min()).clamp(min=1e-4)) + x.median()


def _flat_range(rng: Generator, x: Tensor, severity: float) -> Tensor:
    """Returns log depth x (1, 1, H, W) with what is beyond a random distance compressed."""
    limit = torch.quantile(x.flatten(), float(rng.uniform(0.4, 0.95)))
    return torch.where(x > limit, limit + (x - limit) * float(rng.uniform(0.1, 0.8)), x)


def _wrong_planes(rng: Generator, x: Tensor, severity: float) -> Tensor:
    """Returns log depth x (1, 1, H, W) with one to three windows at another offset and tilt."""
    height, width = x.shape[-2:]
    rows = torch.linspace(-1.0, 1.0, height)[:, None]
    columns = torch.linspace(-1.0, 1.0, width)[None, :]
    for _ in range(int(rng.integers(1, 4))):
        offset, down, right = (rng.normal(0.0, 0.25, 3) * severity).tolist()
        inside = torch.from_numpy(window(rng, (height, width)))
        x = torch.where(inside, x + offset + down * rows + right * columns, x)
    return x


def _tiles(rng: Generator, x: Tensor, severity: float) -> Tensor:
    """Returns log depth x (1, 1, H, W) in tiles with a scale each, as tiled inference leaves it."""
    count = rng.integers(2, 5, 2)
    offsets = torch.from_numpy(rng.normal(0.0, 0.1 * severity, (1, 1, *count))).float()
    return x + F.interpolate(offsets, x.shape[-2:], mode="nearest")


def _noise(rng: Generator, x: Tensor, severity: float) -> Tensor:
    """Returns log depth x (1, 1, H, W) with smooth noise of a random frequency."""
    cells = int(np.exp(rng.uniform(np.log(8.0), np.log(96.0))))
    return x + _field(rng, x, cells) * float(rng.uniform(0.005, 0.1) * severity)


FAULTS: tuple[Callable[[Generator, Tensor, float], Tensor], ...] = (
    _lost_details, _displaced, _wrong_planes, _contrast, _affine, _flat_range, _tiles,
    _scale_field, _blurred, _noise,
)  # fmt: skip
"""Functions of random numbers, log depth and a severity in 0…1, which scales the error."""


def _field(rng: Generator, like: Tensor, cells: int, channels: int = 1) -> Tensor:
    """Returns a smooth random field (1, channels, H, W) of the size of a map.

    Args:
        rng: Random numbers.
        like: The map (…, H, W).
        cells: Nodes along either axis, whose values have unit variance.
        channels: Number of fields.
    """
    grid = rng.normal(0.0, 1.0, (1, channels, cells, cells))
    return _enlarged(torch.from_numpy(grid).float(), like.shape[-2:])


def _smooth(x: Tensor, factor: int) -> Tensor:
    """Returns a map (1, 1, H, W) averaged over cells of so many pixels and enlarged again."""
    return _enlarged(F.avg_pool2d(x, factor, ceil_mode=True), x.shape[-2:])


def _enlarged(x: Tensor, size: tuple[int, ...] | torch.Size) -> Tensor:
    """Returns a map (1, c, …) at the size (H, W), interpolated bilinearly."""
    return F.interpolate(x, tuple(size), mode="bilinear", align_corners=False)
