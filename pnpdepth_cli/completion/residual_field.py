"""The residual at the sparse points, and the features of every pixel.

The residual is r = log measured depth − log predicted depth. A propagation predicts it at every
pixel from the points, by features of the pixels: position, predicted depth and colour.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from pnpdepth_cli.completion.alignment import where_predicted
from pnpdepth_cli.completion.interpolation import distinct
from pnpdepth_cli.points import SparsePoints, in_frame

DEPTH = 2
"""Position of the predicted log depth among the features."""
_FLAT_DEPTH, _FLAT_COLOUR = 1e-3, 1.0  # added to standard deviations: a flat image has no edges
_XYZ_OF_RGB = (
    (0.4124564, 0.3575761, 0.1804375),
    (0.2126729, 0.7151522, 0.0721750),
    (0.0193339, 0.1191920, 0.9503041),
)  # IEC 61966-2-1


@dataclass(frozen=True, kw_only=True)
class Kernel:
    """Covariance of a Gaussian process: its length scales and its noise."""

    depth: float = 2.5  # length scale of the predicted log depth
    colour: float = 8.0  # length scale of the colour
    noise: float = 1e-3  # variance of the noise

    def scaled(self, features: Tensor) -> Tensor:
        """Returns features (..., 3 or 6) divided by their length scales."""
        lengths = [1.0, 1.0, self.depth, *[self.colour] * (features.shape[-1] - 3)]
        return features / features.new_tensor(lengths)


@dataclass(frozen=True, kw_only=True)
class ResidualField:
    """A residual that is known at N points of an image."""

    features: tuple[Tensor, ...]  # 3 or 6 maps (H, W), see `features_of`
    points: SparsePoints  # the points at pixel coordinates of the image, on the CPU
    at: Tensor  # (N, 3 or 6), features at the points
    residual: Tensor  # (N,) float64, log measured − log predicted depth
    kernel: Kernel = Kernel()  # covariance; `gaussian_process.fit` chooses it

    def features_at(self, queries: SparsePoints) -> Tensor:
        """Returns the features (M, 3 or 6) at the coordinates of M points."""
        return _sample(self.features, queries)

    def select(self, mask: Tensor) -> ResidualField:
        """Returns the field with only the points where mask (N,) is true."""
        points, at, residual = self.points.select(mask), self.at[mask], self.residual[mask]
        return replace(self, points=points, at=at, residual=residual)


def residual_field(prediction: Tensor, points: SparsePoints, rgb: Tensor | None) -> ResidualField:
    """Returns the residual at the points that lie in the image and have a prediction.

    Of several points at the same coordinates the nearest counts.

    Args:
        prediction: (H, W) metres; not positive or not finite is unknown.
        rgb: (3, H, W) in 0…1, or None.

    Raises:
        NoPointsError: No point has a prediction.
    """
    prediction, points = prediction.detach().cpu(), points.tensors()
    inside = in_frame(points.xy, points.size, closed=True)
    known, points = where_predicted(prediction, points.select(inside))
    points = distinct(points)
    features = features_of(
        torch.where(known, prediction, torch.nan).log(), None if rgb is None else rgb.cpu()
    )
    predicted = points.sample(torch.where(known, prediction, 1.0)).double()
    return ResidualField(
        features=features,
        points=points,
        at=_sample(features, points),
        residual=points.depth.double().log() - predicted.log(),
    )


def features_of(log_depth: Tensor, rgb: Tensor | None) -> tuple[Tensor, ...]:
    """Returns 3 or 6 maps (H, W) float32: x and y, predicted log depth, CIELAB colour.

    x and y are in units of the longer side; depth and colour in standard deviations over the image.

    Args:
        log_depth: (H, W), NaN where unknown.
        rgb: (3, H, W) in 0…1, or None.
    """
    height, width = log_depth.shape
    y, x = (torch.arange(float(n)) / max(height, width) for n in (height, width))
    known = log_depth.isfinite()
    values = log_depth if bool(known.all()) else log_depth[known]  # picking them is slow
    values = values.double().flatten()
    mean = values.mean()
    std = (values.dot(values) / len(values) - mean.square()).clamp_min(0).sqrt()
    u = torch.where(known, (log_depth - mean) / (std + _FLAT_DEPTH), 0.0)
    maps = x.expand(height, width), y[:, None].expand(height, width), u.float()
    return maps if rgb is None else (*maps, *_colour(rgb))


def _sample(features: tuple[Tensor, ...], points: SparsePoints) -> Tensor:
    """(N, 3 or 6): the features at the points."""
    return torch.stack([points.sample(one) for one in features], dim=1)


@functools.lru_cache(maxsize=2)
def _colour(rgb: Tensor) -> Tensor:
    """CIELAB (3, H, W), its mean 0 and its standard deviation over the image about 1.

    Remembered for the last image, whose residuals are propagated several times, and for a grey one.
    """
    lab = cielab(rgb)
    lab = lab - lab.mean(dim=(1, 2), keepdim=True)
    return lab / (lab.square().sum(dim=0).mean().sqrt() + _FLAT_COLOUR)


def cielab(rgb: Tensor) -> Tensor:
    """Returns (3, H, W) CIELAB (CIE 1976, white D65) of an sRGB image (3, H, W) in 0…1."""
    linear = torch.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055).clamp_min(0) ** 2.4)
    matrix = rgb.new_tensor(_XYZ_OF_RGB)
    xyz = torch.einsum("ij,jhw->ihw", matrix / matrix.sum(dim=1, keepdim=True), linear)
    root = xyz.clamp_min(1e-6).pow(1 / 3)
    x, y, z = torch.where(xyz > 216 / 24389, root, xyz * (24389 / 27 / 116) + 16 / 116)
    return torch.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)])
