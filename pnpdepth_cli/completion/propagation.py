"""What refinement leaves at the sparse points, spread over the picture without training.

The residual r = log true depth − log predicted depth is known at the points. Spread to every
pixel, the depth is exp(r) · prediction, so that it is positive everywhere, and r never goes beyond
what it is at the points. "gp" spreads it by a Gaussian process (`kriging`): better on rendered
rooms, and it has a standard deviation. "diffusion" solves one linear system that keeps to the edges
(`diffusion`).

A prediction of 0, or not finite, is unknown and stays 0 in the result; points there tell nothing,
like points beyond the frame. Of points at one place the nearest counts.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from pnpdepth_cli.completion.alignment import where_predicted
from pnpdepth_cli.completion.diffusion import diffused
from pnpdepth_cli.completion.gaussian_process import Field, at_places, believed, fitted, spread
from pnpdepth_cli.completion.interpolation import distinct
from pnpdepth_cli.errors import UsageError
from pnpdepth_cli.points import SparsePoints, in_frame

PROPAGATIONS = ("none", "gp", "diffusion")

_WITHIN = 0.68  # share of normal errors within ± one standard deviation
_PASSES = 3  # looks for wrong points: without the worst, others stand out
_FLAT_DEPTH, _FLAT_COLOUR = 1e-3, 1.0  # added to the spreads: a flat picture has no edges
_XYZ_OF_RGB = (
    (0.4124564, 0.3575761, 0.1804375),
    (0.2126729, 0.7151522, 0.0721750),
    (0.0193339, 0.1191920, 0.9503041),
)  # IEC 61966-2-1


@dataclass(frozen=True, kw_only=True)
class Propagated:
    """Depth (H, W) float32 metres, 0 = unknown; sigma: its standard deviation (H, W), metres."""

    depth: Tensor
    sigma: Tensor | None = None


def propagate(
    prediction: Tensor,
    points: SparsePoints,
    rgb: Tensor | None,
    *,
    kind: str = "gp",
    sigma: bool = False,
) -> Propagated:
    """The prediction with what is left at the points spread over it.

    prediction: (H, W) metres. rgb: (3, H, W) in 0..1, or None. kind: one of PROPAGATIONS.
    sigma: with kind "gp" only, else UsageError. It is told by the points that the correction is
    made from; where these have been fitted before, `calibration` says how much too small it is.
    NoPointsError if no point lies where there is a prediction, except with kind "none".
    """
    _check(kind)
    if sigma and kind != "gp":
        raise UsageError(f"propagation {kind!r} has no standard deviation; take 'gp'")
    known = prediction.isfinite() & (prediction > 0)
    if kind == "none":
        return Propagated(depth=torch.where(known, prediction, 0.0).float())
    field = _field(prediction, points, rgb)
    correction, deviation = (
        (diffused(field), None) if kind == "diffusion" else spread(fitted(field), sigma=sigma)
    )
    factor = _held(correction, field).exp().to(prediction.device)
    depth = torch.where(known, prediction * factor, 0.0).float()
    if deviation is None:
        return Propagated(depth=depth)
    return Propagated(depth=depth, sigma=depth * deviation.to(depth.device))


def propagated_at(
    prediction: Tensor,
    points: SparsePoints,
    rgb: Tensor | None,
    places: Tensor,
    *,
    kind: str = "gp",
) -> Tensor:
    """Depth (M,) metres at places (M, 2), xy in pixels, from the points only.

    With "gp" only the places are worked out; with many points each is told by those nearest to it
    instead of to its part of the picture. 0 where the prediction is unknown. Errors as above.
    """
    _check(kind)
    asked = SparsePoints(xy=places, depth=torch.ones_like(places[:, 0]), size=points.size)
    known = prediction.isfinite() & (prediction > 0)
    predicted = asked.sample(torch.where(known, prediction, torch.nan)).nan_to_num(0.0)
    if kind == "none":
        return predicted.float()
    field, asked = _field(prediction, points, rgb), asked.tensors()
    if kind == "diffusion":
        correction = asked.sample(diffused(field))
    else:
        at = torch.stack([asked.sample(one) for one in field.features.unbind(2)], dim=1)
        correction = at_places(fitted(field), asked.xy, at)
    return (predicted * _held(correction, field).exp().to(predicted.device)).float()


def calibration(residual: Tensor, sigma: Tensor) -> float:
    """The factor for sigma with which 68 % of the residuals lie within ± one sigma.

    residual: (M,) true − predicted at points that were held out of refinement and propagation, in
    the unit of their sigma (M,). 1.0 without any: nothing is known against it. One more residual
    lies within as often as that, however few there are (split conformal prediction, Lei et al.,
    "Distribution-free predictive inference for regression", 2018).
    """
    beyond = (residual.double().abs() / sigma.double()).flatten()
    beyond = beyond[beyond.isfinite()]
    if not len(beyond):
        return 1.0
    place = math.ceil(_WITHIN * (len(beyond) + 1))
    return float(beyond.sort().values[min(place, len(beyond)) - 1])


def features_of(log_depth: Tensor, rgb: Tensor | None) -> Tensor:
    """(H, W, 3 or 6) float32: x and y in longer sides, predicted log depth, CIELAB colour.

    log_depth: (H, W), NaN where unknown. The last two in standard deviations over the picture.
    """
    height, width = log_depth.shape
    y, x = (torch.arange(float(n)) / max(height, width) for n in (height, width))
    place = torch.stack([x.expand(height, width), y[:, None].expand(height, width)], dim=-1)
    known = log_depth[log_depth.isfinite()].double()
    u = (log_depth - known.mean()) / (known.std(correction=0) + _FLAT_DEPTH)
    maps = [place, u.nan_to_num(0.0)[..., None]]
    if rgb is not None:
        lab = cielab(rgb)
        lab = lab - lab.mean(dim=(0, 1))
        maps.append(lab / (lab.square().sum(dim=-1).mean().sqrt() + _FLAT_COLOUR))
    return torch.cat(maps, dim=-1).float()


def cielab(rgb: Tensor) -> Tensor:
    """(H, W, 3) CIELAB (CIE 1976, white D65) of an sRGB picture (3, H, W) in 0..1."""
    linear = torch.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055).clamp_min(0) ** 2.4)
    matrix = rgb.new_tensor(_XYZ_OF_RGB)
    xyz = torch.einsum("ij,jhw->ihw", matrix / matrix.sum(dim=1, keepdim=True), linear)
    root = xyz.clamp_min(1e-6).pow(1 / 3)
    x, y, z = torch.where(xyz > 216 / 24389, root, xyz * (24389 / 27 / 116) + 16 / 116)
    return torch.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], dim=-1)


def _check(kind: str) -> None:
    if kind not in PROPAGATIONS:
        raise UsageError(f"there is no propagation {kind!r}; take one of {', '.join(PROPAGATIONS)}")


def wrong(prediction: Tensor, points: SparsePoints, rgb: Tensor | None) -> Tensor:
    """(N,) bool: the points that are wrong, if there clearly are any: others tell them otherwise.

    prediction: (H, W) metres. rgb: (3, H, W) in 0..1, or None. NoPointsError as in `propagate`.
    """
    field = _all_points(prediction, points, rgb)
    places = _keys(field.points)
    places = places[~torch.isin(places, _keys(_without_wrong(field).points))]
    return torch.isin(_keys(points.tensors()), places).to(points.xy.device)


def _keys(points: SparsePoints) -> Tensor:
    """A number (N,) int64 for each place: x and y bit by bit."""
    return points.xy.float().contiguous().view(torch.int64).flatten()


def _field(prediction: Tensor, points: SparsePoints, rgb: Tensor | None) -> Field:
    """What is left at the points that lie in the frame, have a prediction and are believed."""
    return _without_wrong(_all_points(prediction, points, rgb))


def _without_wrong(field: Field) -> Field:
    for _ in range(_PASSES):
        kept = believed(field)
        if bool(kept.all()):
            break
        field = field.select(kept)
    return field


def _all_points(prediction: Tensor, points: SparsePoints, rgb: Tensor | None) -> Field:
    """The same with those that are not believed, too."""
    prediction, points = prediction.detach().cpu(), points.tensors()
    inside = in_frame(points.xy, points.size, closed=True)
    known, points = where_predicted(prediction, points.select(inside))
    points = distinct(points)
    features = features_of(
        torch.where(known, prediction, torch.nan).log(), None if rgb is None else rgb.cpu()
    )
    predicted = points.sample(torch.where(known, prediction, 1.0)).double()
    return Field(
        features=features,
        points=points,
        at=torch.stack([points.sample(one) for one in features.unbind(2)], dim=1),
        residual=points.depth.double().log() - predicted.log(),
    )


def _held(correction: Tensor, field: Field) -> Tensor:
    """The correction within what it is at the points."""
    return correction.clamp(float(field.residual.min()), float(field.residual.max()))
