"""The standard deviation of a depth map, calibrated by validation points (`--uncertainty`).

Errors of depth have heavy tails: they are small within a surface and as large as the step at a
depth edge. One standard deviation for all pixels would hold too many errors within ± σ or too few
within ± 2σ, so σ varies over the image. Its shape is a product of powers of four differences of log
depth, which are large where depth is uncertain:

- between the depth map and linear interpolation of the points,
- between the depth map and the mean of the 3 nearest points,
- among the 8 nearest points,
- of the network's own depth over a small window.

The exponents are constants. The scale is fitted to validation points. They are as far from the
other points as the pixels whose depth is asked for: a LiDAR's are whole scan lines.
"""

from __future__ import annotations

import math
from dataclasses import replace

import torch
import torch.nn.functional as F
from torch import Tensor

from pnpdepth_cli.completion.interpolation import in_hull, linear, nearest_points, pixels_of
from pnpdepth_cli.frames.frame import Refined, Validation, is_dense
from pnpdepth_cli.measures import AFTER
from pnpdepth_cli.points import SparsePoints
from pnpdepth_cli.scan_pattern import scan_pattern

MIN_INLIER_WEIGHT = 0.05
"""Validation points with less weight do not calibrate."""
CALIBRATION_RANGE = (0.01, 1000.0)
"""Bounds of the calibration factor, whatever a few points give."""
VALID_SIGMA = 0.25
"""Depth with a larger standard deviation, as a fraction of it, is not valid."""
BEYOND_RANGE_SIGMA = 0.5
"""Standard deviation of depth beyond a sensor's range, as a fraction of it: it may be anywhere."""
SENSOR_ERROR = 0.01
"""Standard deviation of the error that the points of a dense map share, as a fraction of the depth.

At 2 m, the data sheets of Azure Kinect (11 mm + 0.1 %) and RealSense D400 give 0.65 and 2 %.
"""

# Exponents are fitted to 21 refinements of 7-Scenes, ICL-NUIM and even KITTI frames by the pinball
# losses of the 68 and 95 % quantiles; the factors to 78 refinements of even frames of these sets.
_EXPONENTS = (0.58, 0.10, 0.42, 0.18)
"""Powers of the four differences, in the order of the module's list."""
_LEAST = 0.003
"""Log depth added to each difference."""
_LEAST_DEPTH = 1e-6
"""Metres; depth is at least this before its logarithm is taken."""
_MEAN_OF = 3
"""Nearest points whose mean the depth is compared with."""
_AMONG = 8
"""Nearest points among which depth may differ."""
_WINDOW_PX = 9
"""Side of the window over which the network's own depth may range."""

# The factor of σ.
_WITHIN = (0.68, 0.95)
"""Fractions of normal errors within one and two standard deviations."""
_TAIL = 0.75
"""Weight of the second fraction, 95 % within 2σ, in the factor: where tails are heavy, no factor
gives both."""
_TYPICAL = 1.75
"""Typical factor of σ with 100 points."""
_PER_POINT = -0.18
"""Exponent: with N points the typical factor is `_TYPICAL` times (N / 100) to this power."""
_FEWEST_POINTS = 20
"""With fewer points the typical factor is that of so many."""
_MOST_POINTS = 500
"""With more points the typical factor is that of so many."""
_TYPICAL_WEIGHT = 20
"""Validation points that the typical factor counts as."""
_LEAST_RATIO = 1e-12
"""Residual over sigma before its logarithm is taken; a residual can be 0."""

# Where depth is valid.
_BEYOND_POINTS = 1.5
"""Depths up to this multiple of the farthest point are valid."""
_BEYOND_HULL = 2.0
"""Typical distances to the nearest point up to which depth outside the points' hull is valid."""
_TYPICAL_QUANTILE = 0.95
"""Quantile of the distances inside the hull that is typical."""
_SAMPLED = 4000
"""Pixels that the typical distance is measured at."""

# What is beyond the range of a sensor.
_END = 0.85
"""Fraction of the farthest depth from which on a point is at the end of the range. The band before
it is as deep."""
_SHARP = 0.5
"""Least points at the end over those in the band before, if the points end sharply."""
_LEAST_AT_END = 0.02
"""Least fraction of all points that are at the end of a sensor's range."""
_FEWEST_AT_END = 10
"""Least number of points that are at the end of a sensor's range."""
_GAP = 3.6
"""Median spacings from a pixel in a gap to the nearest point. Of random pixels 0.01 % are farther
from one."""
_GAP_LINES = 1.2
"""Spacings of scan lines from a pixel in a gap to the nearest point."""
_REACHED = 0.8
"""Distance from the middle of a gap up to which pixels belong to the gap, over the distance from
points at which the middle begins."""
_LEAST_GAP = 0.01
"""Least fraction of the image's pixels that are so far from any point."""
_LARGE_GAPS = 0.05
"""Fraction of the image's pixels in gaps, from which on gaps tell without a sharp end. Of 12 rooms
with all their depth two have as large gaps, with no point at the end beside them."""
_AT_BORDER = 0.25
"""Least fraction of the points beside the gaps that are at the end."""

_OF_MATCHES = (
    "note: of points that were matched in images, ±2σ holds about 80 % of the true depths: they"
    " lie on texture, where depth is easy"
)
_OF_MAP = (
    "note: so dense, points share the errors of their sensor, of which validation points show"
    f" nothing: σ has {100 * SENSOR_ERROR:g} % of the depth added for them"
)


def with_uncertainty(frame: Refined, *, of_matches: bool = False) -> Refined:
    """Returns a refined frame with the standard deviation of its depth, and where that is valid.

    The deviation is calibrated by the frame's validation points. Notes say what it does not cover.

    Args:
        frame: The refined frame.
        of_matches: Whether its points were matched in images, as those of COLMAP.
    """
    points = frame.used
    network = torch.from_numpy(frame.before)
    depth = torch.from_numpy(frame.depth)
    # The shape of the standard deviation, calibrated at the validation points.
    shape = relative_shape(points, network, depth)
    residual = torch.empty(0)
    residual_sigma = torch.empty(0)
    note = "uncertainty: too few points to calibrate it with"
    if frame.validation is not None:
        residual, residual_sigma = _residuals(frame.validation)
        note = f"uncertainty: calibrated with {len(residual):,} validation points"
    of_points = calibration(residual, residual_sigma, len(points)) * shape
    # Two deviations come on top: the error that all points of a sensor share, and that beyond its
    # range. Independent deviations add up by their squares. All are fractions of the depth, as
    # deviations of log depth are, until they are multiplied by it.
    is_map = is_dense(points) and scan_pattern(points.xy, points.size) is None
    of_sensor = torch.tensor(SENSOR_ERROR if is_map else 0.0)
    beyond = beyond_range(points)
    of_range = torch.where(beyond, BEYOND_RANGE_SIGMA, 0.0)
    sigma = of_points.hypot(of_sensor).hypot(of_range) * depth
    valid = valid_depth(points, depth, sigma)
    # Notes on the points.
    notes = [*frame.notes, note]
    if of_matches:
        notes.append(_OF_MATCHES)
    if is_map:
        notes.append(_OF_MAP)
    if bool(beyond.any()):
        notes.append(
            f"note: the points end sharply at a depth of {float(points.depth.max()):.3g}, with none"
            f" in {100 * float(beyond.double().mean()):.0f} % of the image, which is taken as"
            " beyond the sensor's range: not valid"
        )
    # A note on the pixels that are not valid.
    if not bool(valid.all()):
        count = int((~valid).sum())
        percent = round(100 * count / valid.numel())
        what = f"{percent} % of the image" if percent else f"{count:,} of {valid.numel():,} pixels"
        notes.append(f"note: the depth of {what} is beyond what the points support, and not valid")
    return replace(frame, sigma=sigma.numpy(), valid=valid.numpy(), notes=tuple(notes))


def _residuals(validation: Validation) -> tuple[Tensor, Tensor]:
    """Log measured − log predicted depth at K validation points, (K,), and its deviation, (K,).

    The standard deviation is not calibrated yet: it is that of `relative_shape`. The K points have
    a prediction and are no outliers.
    """
    predicted = validation.predicted[AFTER]
    points = validation.points
    sigma = relative_shape(validation.kept, validation.network, predicted, points.xy)
    usable = (validation.weights > MIN_INLIER_WEIGHT) & (predicted > 0)
    return points.depth[usable].log() - predicted[usable].log(), sigma[usable]


def relative_shape(
    points: SparsePoints, network: Tensor, depth: Tensor, xy: Tensor | None = None
) -> Tensor:
    """Returns the standard deviation of log depth up to a factor, which `calibration` finds.

    Args:
        points: The points that the depth was fitted to.
        network: (H, W) metres, 0 = unknown: the network's own depth, aligned with the points.
        depth: (H, W), or (M,) with `xy`, metres, 0 = unknown: the depth whose deviation it is.
        xy: (M, 2) pixel coordinates of `depth`. None: every pixel.

    Returns:
        (H, W), or (M,) as `depth`.
    """
    # How far the network's own log depth ranges over a window, at every pixel.
    is_known = network > 0
    filled = network.new_tensor(1.0)  # where unknown, so that its logarithm is finite
    if bool(is_known.any()):
        filled = network[is_known].median()
    log_network = torch.where(is_known, network, filled).log()[None, None]
    half_px = _WINDOW_PX // 2
    highest = F.max_pool2d(log_network, _WINDOW_PX, stride=1, padding=half_px)
    lowest = -F.max_pool2d(-log_network, _WINDOW_PX, stride=1, padding=half_px)
    ranges = highest - lowest
    # The positions at which the standard deviation is wanted, and the range there.
    if xy is None:
        queries = pixels_of(points.size)
        network_range = ranges.flatten()
    else:
        queries = xy.double()
        positions = SparsePoints(xy=xy, depth=xy.new_ones(len(xy)), size=points.size)
        network_range = positions.sample(ranges[0, 0])
    # Log depth of the nearest points.
    _, numbers = nearest_points(points, queries, min(_AMONG, len(points)))
    log_nearest = points.depth.double().log()[numbers.reshape(len(queries), -1)]
    low, high = log_nearest.aminmax(dim=1)
    # The four differences of log depth, as in the module's list.
    log_depth = depth.clamp_min(_LEAST_DEPTH).log().double().flatten()
    log_linear = linear(points, xy).clamp_min(_LEAST_DEPTH).log().double().flatten()
    differences = (
        (log_linear - log_depth).abs(),
        (log_nearest[:, :_MEAN_OF].mean(dim=1) - log_depth).abs(),
        high - low,
        network_range.double(),
    )
    # The product of their powers, as the exponential of a sum of logarithms.
    logarithms = [
        exponent * (difference + _LEAST).log()
        for exponent, difference in zip(_EXPONENTS, differences, strict=True)
    ]
    return torch.stack(logarithms).sum(dim=0).exp().reshape(depth.shape).float()


def calibration(residual: Tensor, sigma: Tensor, points: int) -> float:
    """Returns the factor of sigma by which about 68 % of residuals lie within ± one sigma.

    The factor is the weighted geometric mean of two: with one, 68 % lie within ± one sigma, with
    the other, 95 % within ± two. They agree for normal errors. Ranks are those of split conformal
    prediction (Lei et al., "Distribution-free predictive inference for regression", 2018). Few
    residuals give an uncertain factor, so it is averaged with the typical one for that number of
    points, which is the factor without any residual.

    Args:
        residual: (M,) log measured − log predicted depth at points that neither refinement nor
            propagation used.
        sigma: (M,) their standard deviations up to the factor, in log depth.
        points: Number of points that the depth was fitted to.
    """
    count_for_typical = min(max(points, _FEWEST_POINTS), _MOST_POINTS)
    typical = _TYPICAL * math.pow(count_for_typical / 100, _PER_POINT)
    ratio = (residual.double().abs() / sigma.double()).flatten()
    ratio = ratio[ratio.isfinite()].sort().values
    if not len(ratio):
        return typical
    # How many σ hold 68 % of the residuals, which should be one, and 95 %, which should be two.
    count = len(ratio)
    ranks = [min(math.ceil(fraction * (count + 1)), count) - 1 for fraction in _WITHIN]
    of_68, of_95 = (max(float(ratio[rank]), _LEAST_RATIO) for rank in ranks)
    # The geometric mean of the two factors, and that of this and the typical factor. The weight
    # rises from 0 to 1 with the number of residuals.
    of_residuals = (1 - _TAIL) * math.log(of_68) + _TAIL * math.log(of_95 / 2)
    weight = count / (count + _TYPICAL_WEIGHT)
    low, high = CALIBRATION_RANGE
    factor = math.exp(weight * of_residuals + (1 - weight) * math.log(typical))
    return min(max(factor, low), high)


def valid_depth(points: SparsePoints, depth: Tensor, sigma: Tensor) -> Tensor:
    """Returns (H, W) true where the depth map is supported by the points.

    False where depth is unknown or far beyond the farthest point, and where σ is above a quarter of
    the depth. Also false outside the hull of the points, such as in the sky above a LiDAR's scan
    lines, except at pixels about as near to a point as the pixels inside the hull are.

    Args:
        points: The points that the depth was fitted to.
        depth: (H, W) metres, 0 = unknown.
        sigma: (H, W) metres, standard deviation of the depth.
    """
    supported = (depth > 0) & (depth <= _BEYOND_POINTS * float(points.depth.max()))
    valid = supported & (sigma <= VALID_SIGMA * depth)
    # Pixels inside the hull, and those outside that are as near to a point. `flip` makes x and y of
    # rows and columns.
    is_near = in_hull(points)  # (H, W)
    outside = torch.nonzero(~is_near).flip(1)
    inside = torch.nonzero(is_near & ~beyond_range(points)).flip(1)
    if len(outside) and len(inside):
        sample = inside[:: max(1, len(inside) // _SAMPLED)]  # evenly spaced ones
        inside_px, _ = nearest_points(points, sample.double(), 1)
        outside_px, _ = nearest_points(points, outside.double(), 1)
        typical_px = float(inside_px.quantile(_TYPICAL_QUANTILE))
        is_near[~is_near] = outside_px.flatten() <= _BEYOND_HULL * typical_px
    return valid & is_near


def beyond_range(points: SparsePoints) -> Tensor:
    """Returns (H, W) true where surfaces are beyond the sensor's range, as its points tell.

    These are the gaps among and beside the points, if many of the points beside the gaps are at
    the end of the range, near the depth of the farthest point. Gaps may have other causes: a scan
    has no returns from the sky, and small gaps are surfaces without return. So for a scan, and for
    small gaps, the points must also end sharply: many at the end of the range, few before it. False
    everywhere if the points tell of no such range.

    Args:
        points: The points that the depth was fitted to.
    """
    from scipy import ndimage

    nowhere = torch.zeros(points.size, dtype=torch.bool)
    # Many points are at the end of the range.
    depth = points.depth.double()
    farthest = float(depth.max())
    is_at_end = depth >= _END * farthest
    at_end = int(is_at_end.sum())
    if at_end < max(_LEAST_AT_END * len(points), _FEWEST_AT_END):
        return nowhere  # the farthest points are single ones
    # The gaps: pixels too far from any point for their spacing.
    to_next_px, _ = nearest_points(points, points.xy.double(), 2)  # to itself, and to the next
    reach_px = _GAP * float(to_next_px[:, 1].median())
    pattern = scan_pattern(points.xy, points.size)
    if pattern is not None:
        _, across_px = pattern
        reach_px = max(reach_px, _GAP_LINES * across_px)
    distance_px, nearest = nearest_points(points, pixels_of(points.size), 1)
    is_gap = (distance_px.flatten() > reach_px).reshape(points.size)
    fraction_in_gaps = float(is_gap.double().mean())
    if fraction_in_gaps < _LEAST_GAP:
        return nowhere
    # Points end sharply where those of the band before the end, which is as deep, are not far more:
    # a scene thins out.
    begin_of_band = 2 * _END - 1  # as far below `_END` as 1 is above it
    is_before = (depth >= begin_of_band * farthest) & ~is_at_end
    is_sharp = at_end >= _SHARP * int(is_before.sum())
    must_be_sharp = pattern is not None or fraction_in_gaps < _LARGE_GAPS
    if must_be_sharp and not is_sharp:
        return nowhere
    # Of the points beside the gaps, enough are at the end.
    beside = torch.unique(nearest.flatten()[is_gap.flatten()])
    if float(is_at_end[beside].double().mean()) < _AT_BORDER:
        return nowhere
    # Pixels so far from points are the middle of a gap; the gap reaches from it to near the points.
    around = ndimage.distance_transform_edt(~is_gap.numpy()) <= _REACHED * reach_px
    return torch.from_numpy(around)
