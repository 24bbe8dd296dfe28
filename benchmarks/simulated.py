"""Networks that are not there: one that returns a stored map, and one of a wanted strength.

A network of the wanted strength is made from ground truth. Its log depth is off by a smooth field,
one addend a region and a gamma, in proportions that are drawn anew for each frame, and its edges
are blurred. Their common amplitude is what gives the wanted error after alignment. It returns
inverse depth up to scale and shift, as relative networks do, through a small decoder, so that z can
be updated.

    python -m benchmarks.simulated --gt samples/indoor/gt.png --out samples/indoor/predicted.npy

writes what such a network of 4 % error predicts for a frame.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from numpy.random import Generator
from numpy.typing import NDArray
from torch import Tensor, nn

from model_zoo_defs.training.learning.priors import filled
from pnpdepth_cli.choices import OutputKind, OutputScale
from pnpdepth_cli.io.atomic import atomic_path
from pnpdepth_cli.io.depth import read_depth
from pnpdepth_cli.models.definition import UNTUNED_DEFAULTS, Fixed, ModelDefinition, Settings
from pnpdepth_cli.models.network import Network, load_network

Depth = NDArray[np.float32]

ERROR_OF_SAMPLE = 0.04
SEED_OF_SAMPLE = 1

EDGE_BLUR_PX = 1.5
"""Standard deviation of the blur of log depth."""
MOST_OF_BLUR = 0.7
"""Part of the wanted error that the blur alone may make; it is halved until it does not."""
REGIONS = 12
DEPTH_IN_REGIONS = 3.0
"""Standard deviations of log depth that a region's border counts like the image's longer side."""
FIELD_NODES = (4, 5)
"""Rows and columns of the random values between which the smooth field is interpolated."""
CHANNELS = 8
"""Channels of the decoder's feature map."""
STRIDE = 16
"""Pixels of the image in a pixel of the feature map."""
OF_DECODER = 0.5
"""Standard deviation of what the decoder adds to the map, over that of the map."""


class StoredMap(nn.Module):
    """Returns a stored map, whatever the image."""

    def __init__(self, values: Depth) -> None:
        super().__init__()
        self.register_buffer("values", torch.from_numpy(values)[None, None])
        self.map = nn.Identity()

    def forward(self, _rgb: Tensor) -> Tensor:
        """Returns the map (1, 1, H, W)."""
        stored: Tensor = self.map(self.values)
        return stored


class DecodedMap(nn.Module):
    """Returns a stored map for one image, and another one if its feature map is changed.

    The decoder has random weights. What it adds for this image is taken from the map beforehand.
    """

    def __init__(self, values: Depth, rgb: Tensor, seed: int) -> None:
        super().__init__()
        torch.manual_seed(seed)
        self.encode = nn.Conv2d(3, CHANNELS, STRIDE, stride=STRIDE)
        self.decode = nn.Sequential(
            nn.Conv2d(CHANNELS, CHANNELS, 3, padding=1),
            nn.ReLU(),
            nn.Upsample(scale_factor=STRIDE // 4, mode="bilinear"),
            nn.Conv2d(CHANNELS, CHANNELS, 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(CHANNELS, 1, 3, padding=1),
        )
        target = torch.from_numpy(values)[None, None]
        with torch.no_grad():
            added = self.decode(self.encode(rgb[None]))
            self.factor = float(OF_DECODER * target.std() / added.std().clamp_min(1e-6))
        self.register_buffer("rest", torch.zeros_like(target))
        with torch.no_grad():
            self.rest = target - self(rgb[None])

    def forward(self, rgb: Tensor) -> Tensor:
        """Returns the map (1, 1, H, W), changed by what the decoder makes of the image."""
        coarse = self.factor * self.decode(self.encode(rgb))
        size = self.rest.shape[-2:]
        return self.rest + F.interpolate(coarse, size, mode="bilinear", align_corners=False)


def stored_network(name: str, values: Depth, kind: OutputKind, scale: OutputScale) -> Network:
    """Returns a network that gives a stored map (H, W), NaN where unknown; z is not updated."""
    height, width = values.shape
    definition = ModelDefinition(
        name=name,
        input_kind="rgb",
        size=Fixed(height, width),
        build=lambda: StoredMap(values),
        complete=True,
        output_kind=kind,
        output_scale=scale,
        layers=("map",),
        defaults=Settings(iterations=0),
    )
    return load_network(definition, None)


def simulated_network(name: str, gt: Depth, rgb: Depth, error: float, seed: int) -> Network:
    """Returns a relative network that is off by `error` on this frame, after alignment.

    Args:
        name: What the network is called.
        gt: (H, W) metres, 0 = unknown.
        rgb: (H, W, 3) in 0…1.
        error: The wanted mean |aligned / true − 1|.
        seed: Random seed of the errors, and of the decoder's weights.
    """
    rng = np.random.default_rng(seed)
    inverse = 1 / weakened(gt, error, rng)
    # Any scale and shift is as good as another for such a network.
    values = (inverse - inverse.min()) / np.ptp(inverse) * rng.uniform(5, 50) + rng.uniform(0, 5)
    values = values.astype(np.float32)
    image = torch.from_numpy(np.ascontiguousarray(rgb.transpose(2, 0, 1)))
    height, width = gt.shape
    definition = ModelDefinition(
        name=name,
        input_kind="rgb",
        size=Fixed(height, width),
        build=lambda: DecodedMap(values, image, seed),
        complete=True,
        output_kind="inverse",
        output_scale="affine",
        layers=("encode",),
        defaults=UNTUNED_DEFAULTS,
    )
    return load_network(definition, None)


def weakened(gt: Depth, error: float, rng: Generator) -> Depth:
    """Returns dense depth (H, W) in metres that is off by `error` after alignment.

    Args:
        gt: (H, W) metres, 0 = unknown.
        error: The wanted mean |aligned / true − 1| over the pixels with ground truth.
        rng: Random generator of the errors.
    """
    log_depth = filled(gt)[0, 0].numpy()
    fault = _fault(log_depth, rng)

    def off(amplitude: float, blur_px: float) -> float:
        """Returns the error with the faults at this amplitude and the edges blurred so far."""
        return error_aligned(np.exp(_blurred(log_depth + amplitude * fault, blur_px)), gt)

    # Less blur, if it alone makes too much of the error.
    blur_px = EDGE_BLUR_PX
    while off(0.0, blur_px) > MOST_OF_BLUR * error:
        blur_px /= 2
    # The amplitude lies between two, which are halved 12 times.
    low = 0.0
    high = error
    while off(high, blur_px) < error:
        low = high
        high = 2 * high
    for _ in range(12):
        middle = (low + high) / 2
        low, high = (middle, high) if off(middle, blur_px) < error else (low, middle)
    return np.exp(_blurred(log_depth + high * fault, blur_px)).astype(np.float32)


def error_aligned(depth: Depth, gt: Depth) -> float:
    """Returns mean |aligned / true − 1|, of inverse depth fitted by scale and shift.

    The fit is that of least squares of true / aligned, over the pixels with ground truth.
    """
    known = gt > 0
    x = 1 / depth[known].astype(np.float64)
    true = gt[known].astype(np.float64)
    # true / aligned is true · (scale · x + shift), which should be 1: the normal equations.
    system = np.stack([x * true, true], axis=1)
    scale, shift = np.linalg.lstsq(system.T @ system, system.sum(axis=0), rcond=None)[0]
    # At most ten times as far as the farthest true pixel, also where the line is not positive.
    aligned = 1 / np.maximum(scale * x + shift, 0.1 / true.max())
    return float(np.abs(aligned / true - 1).mean())


def _fault(log_depth: Depth, rng: Generator) -> Depth:
    """Returns errors of log depth (H, W), of standard deviation 1."""
    height, width = log_depth.shape
    centred = (log_depth - log_depth.mean()) / max(float(log_depth.std()), 1e-6)
    # A smooth field.
    nodes = rng.standard_normal(FIELD_NODES).astype(np.float32)
    field = cv2.resize(nodes, (width, height), interpolation=cv2.INTER_CUBIC)
    # One addend a region: the pixels near a seed in position and depth.
    rows, columns = np.indices((height, width), dtype=np.float32) / max(height, width)
    places = np.stack([rows, columns, centred / DEPTH_IN_REGIONS], axis=-1)
    seeds = places.reshape(-1, 3)[rng.choice(height * width, REGIONS, replace=False)]
    region = np.argmin([np.square(places - seed).sum(axis=-1) for seed in seeds], axis=0)
    addends = rng.standard_normal(REGIONS).astype(np.float32)[region]
    # A gamma, which a line through inverse depth does not undo.
    gamma = centred * rng.choice((-1, 1))
    # Each with mean 0 and standard deviation 1, and with a proportion of its own.
    proportions = rng.uniform(0.3, 1.0, 3)
    fault = sum(
        proportion * (values - values.mean()) / max(float(values.std()), 1e-6)
        for proportion, values in zip(proportions, (field, addends, gamma), strict=True)
    )
    return (fault / fault.std()).astype(np.float32)


def _blurred(log_depth: Depth, blur_px: float) -> Depth:
    """Log depth (H, W) with its edges blurred."""
    return cv2.GaussianBlur(log_depth, (0, 0), blur_px, borderType=cv2.BORDER_REPLICATE)


def as_outputs(depth: Depth, rng: Generator) -> dict[str, NDArray[np.float64]]:
    """Returns maps (H, W) that networks of this depth give, by what their numbers are.

    Factors and shifts are drawn where such a network knows none.
    """
    metres = depth.astype(np.float64)
    inverse = 1 / metres
    factor = np.exp(rng.normal())
    shift = rng.uniform(-1, 1) * inverse.min()
    disparity = factor * (inverse - shift)
    # As tools add it, so that nothing is divided by 0.
    tiny = 1e-3 * factor * inverse.min()
    return {
        "disparity": disparity,
        "metric": 1.15 * metres,
        "relative": np.exp(rng.normal()) * (metres + rng.uniform(-0.5, 1) * np.median(metres)),
        "log": np.exp(rng.normal()) * (np.log(metres) + rng.normal()),
        "sqrt": np.exp(rng.normal()) * np.sqrt(metres),
        "inverted": 1 / (disparity + tiny),
    }


def relative_inverse(depth: Depth) -> NDArray[np.float16]:
    """Returns inverse depth (H, W) in 0…1, as many tools store it: 1 is the nearest pixel."""
    inverse = 1 / depth
    return ((inverse - inverse.min()) / np.ptp(inverse)).astype(np.float16)


def main() -> None:
    """Write the map that a simulated network predicts for the ground truth of a frame."""
    parser = argparse.ArgumentParser(description="Simulate a network's depth map of one frame.")
    parser.add_argument("--gt", type=Path, required=True, help="ground truth of the frame")
    parser.add_argument("--out", type=Path, required=True, help="the map, as NPY of float16")
    args = parser.parse_args()
    gt = np.nan_to_num(read_depth(args.gt).values).astype(np.float32)
    depth = weakened(gt, ERROR_OF_SAMPLE, np.random.default_rng(SEED_OF_SAMPLE))
    with atomic_path(args.out) as temporary, temporary.open("wb") as file:
        np.save(file, relative_inverse(depth))


if __name__ == "__main__":
    main()
