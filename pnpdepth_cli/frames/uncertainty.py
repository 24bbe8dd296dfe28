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
_LEAST = 0.003  # of log depth, added to each difference
_MEAN_OF, _AMONG = 3, 8  # nearest points
_WINDOW = 9  # pixels
_WITHIN = (0.68, 0.95)  # of normal errors within one and two standard deviations
_TAIL = 0.75  # weight of the second in the scale: both cannot hold where tails are heavy
_TYPICAL, _PER_POINT = 1.75, -0.18  # factor with 100 points, and its power of their number
_FEWEST_POINTS, _MOST_POINTS = 20, 500  # fewer and more change nothing
_TYPICAL_WEIGHT = 20  # validation points that the typical factor counts as
_BEYOND_POINTS = 1.5  # depths up to this multiple of the farthest point are valid
_BEYOND_HULL = 2.0  # typical distances to the nearest point, outside the hull of the points
_END, _SHARP, _LEAST_AT_END = 0.85, 0.5, 0.02
"""Points end sharply if from 0.85 of the farthest on there are half as many as in the band before,
and 2 % of all."""
_GAP = 3.6  # median spacings to the nearest point; of random pixels 0.01 % are farther from one
_GAP_LINES = 1.2  # spacings of scan lines
_REACHED = 0.8  # of it, around the middle of a gap, belong to the gap
_LEAST_GAP = 0.01  # of the image
_AT_BORDER = 0.25  # of the points beside the gaps, that are at the end
_SAMPLED = 4000  # pixels, for the typical distance

_OF_MATCHES = (
    "note: of points that were matched in images, ±2σ holds about 80 % of the true depths: they"
    " lie on texture, where depth is easy"
)
_OF_MAP = (
    "note: so dense, points share the errors of their sensor, of which validation points show"
    f" nothing: σ has {100 * SENSOR_ERROR:g} % of the depth added for them"
)


def with_uncertainty(frame: Refined, *, of_matches: bool = False) -> Refined:
    """Returns a refined frame with its standard deviation, calibrated by its check.

    Args:
        of_matches: Whether its points were matched in images, as those of COLMAP.
    """
    points = frame.used
    network, depth = (torch.from_numpy(each) for each in (frame.before, frame.depth))
    # The shape of the standard deviation, calibrated at the validation points.
    shape, residual, sigma = relative_shape(points, network, depth), torch.empty(0), torch.empty(0)
    note = "uncertainty: too few points to calibrate it with"
    if frame.validation is not None:
        residual, sigma = _residuals(frame.validation)
        note = f"uncertainty: calibrated with {len(residual):,} validation points"
    is_map = is_dense(points) and scan_pattern(points.xy, points.size) is None
    of_points = calibration(residual, sigma, len(points)) * shape
    of_sensor = torch.tensor(SENSOR_ERROR * is_map)
    beyond = beyond_range(points)
    of_range = torch.where(beyond, BEYOND_RANGE_SIGMA, 0.0)
    sigma_m = of_points.hypot(of_sensor).hypot(of_range) * depth
    valid = valid_depth(points, depth, sigma_m)
    notes = [*frame.notes, note, *[_OF_MATCHES] * of_matches, *[_OF_MAP] * is_map]
    if bool(beyond.any()):
        notes.append(
            f"note: the points end sharply at a depth of {float(points.depth.max()):.3g}, with none"
            f" in {100 * float(beyond.double().mean()):.0f} % of the image, which is taken as"
            " beyond the sensor's range: not valid"
        )
    # What it does not cover.
    if not bool(valid.all()):
        count = int((~valid).sum())
        percent = round(100 * count / valid.numel())
        what = f"{percent} % of the image" if percent else f"{count:,} of {valid.numel():,} pixels"
        notes.append(f"note: the depth of {what} is beyond what the points support, and not valid")
    of_depth, is_valid = (each.numpy() for each in (sigma_m, valid))
    return replace(frame, sigma=of_depth, valid=is_valid, notes=tuple(notes))


def _residuals(validation: Validation) -> tuple[Tensor, Tensor]:
    """Residual of log depth and uncalibrated standard deviation, (M,), at validation points."""
    predicted, points = validation.predicted[AFTER], validation.points
    sigma = relative_shape(validation.kept, validation.network, predicted, points.xy)
    good = (validation.weights > MIN_INLIER_WEIGHT) & (predicted > 0)
    return points.depth[good].log() - predicted[good].log(), sigma[good]


def relative_shape(
    points: SparsePoints, network: Tensor, depth: Tensor, xy: Tensor | None = None
) -> Tensor:
    """Returns the uncalibrated standard deviation (H, W), or (M,), of log depth.

    Args:
        points: The points that the depth was fitted to.
        network: (H, W) metres, the network's own depth, aligned with the points.
        depth: (H, W), or (M,), metres.
        xy: (M, 2) pixel coordinates of `depth`. None: every pixel.
    """
    # How far the network's own log depth ranges over a window, at every pixel.
    log_depth = depth.clamp_min(1e-6).log().double()
    known = network > 0
    middle = network[known].median() if bool(known.any()) else network.new_tensor(1.0)
    own = torch.where(known, network, middle).log()[None, None]
    half = _WINDOW // 2
    steps = F.max_pool2d(own, _WINDOW, 1, half) + F.max_pool2d(-own, _WINDOW, 1, half)
    # Where the standard deviation is asked for, and that range there.
    if xy is None:
        queries, step = pixels_of(points.size), steps.flatten()
    else:
        queries = xy.double()
        step = SparsePoints(xy=xy, depth=xy.new_ones(len(xy)), size=points.size).sample(steps[0, 0])
    # Log depth of the nearest points.
    _, near = nearest_points(points, queries, min(_AMONG, len(points)))
    near_depths = points.depth.double().log()[near.reshape(len(queries), -1)]
    low, high = near_depths.aminmax(dim=1)
    flat = log_depth.flatten()
    # The four differences of log depth, as in the module's list.
    differences = (
        (linear(points, xy).clamp_min(1e-6).log().double().flatten() - flat).abs(),
        (near_depths[:, :_MEAN_OF].mean(dim=1) - flat).abs(),
        high - low,
        step.double(),
    )
    # The product of their powers.
    parts = zip(_EXPONENTS, differences, strict=True)
    logarithm = torch.stack([power * (each + _LEAST).log() for power, each in parts]).sum(dim=0)
    return logarithm.exp().reshape(depth.shape).float()


def calibration(residual: Tensor, sigma: Tensor, points: int) -> float:
    """Returns the factor of sigma that brings residuals within ± one and ± two sigma.

    The factor is the weighted geometric mean of two: with one, 68 % lie within ± one sigma, with
    the other, 95 % within ± two. They agree for normal errors. Ranks are those of split conformal
    prediction (Lei et al., "Distribution-free predictive inference for regression", 2018). Few
    residuals give an uncertain factor, so it is averaged with the typical one for that number of
    points.

    Args:
        residual: (M,) true − predicted at points that neither refinement nor propagation used.
        sigma: (M,) their standard deviations, in the same unit.
        points: Number of points that the depth was fitted to.
    """
    points = min(max(points, _FEWEST_POINTS), _MOST_POINTS)
    typical = _TYPICAL * math.pow(points / 100, _PER_POINT)
    ratio = (residual.double().abs() / sigma.double()).flatten()
    ratio = ratio[ratio.isfinite()].sort().values
    if not len(ratio):
        return typical
    ranks = [min(math.ceil(part * (len(ratio) + 1)), len(ratio)) - 1 for part in _WITHIN]
    one, two = (max(float(ratio[rank]), 1e-12) for rank in ranks)
    of_residuals = (1 - _TAIL) * math.log(one) + _TAIL * math.log(two / 2)
    weight = len(ratio) / (len(ratio) + _TYPICAL_WEIGHT)
    low, high = CALIBRATION_RANGE
    factor = math.exp(weight * of_residuals + (1 - weight) * math.log(typical))
    return min(max(factor, low), high)


def valid_depth(points: SparsePoints, depth: Tensor, sigma: Tensor) -> Tensor:
    """Returns (H, W) true where the depth map is supported by the points.

    False where depth is unknown or far beyond the farthest point, and where σ is above a quarter of
    the depth. Also false outside the hull of the points, such as in the sky above a LiDAR's scan
    lines, except at pixels about as near to a point as the pixels inside the hull are.

    Args:
        depth: (H, W) metres.
        sigma: (H, W) metres.
    """
    supported = (depth > 0) & (depth <= _BEYOND_POINTS * float(points.depth.max()))
    valid = supported & (sigma <= VALID_SIGMA * depth)
    inside = in_hull(points)
    outside = torch.nonzero(~inside).flip(1)
    sample = torch.nonzero(inside & ~beyond_range(points)).flip(1)
    if len(outside) and len(sample):
        sample = sample[:: max(1, len(sample) // _SAMPLED)]
        typical = float(nearest_points(points, sample.double(), 1)[0].quantile(0.95))
        distance = nearest_points(points, outside.double(), 1)[0].flatten()
        inside[~inside] = distance <= _BEYOND_HULL * typical
    return valid & inside


def beyond_range(points: SparsePoints) -> Tensor:
    """Returns (H, W) true where a sensor of limited range had no return; nowhere for others.

    That is in gaps among and beside the points, if the points end sharply at one depth and many
    points beside the gaps are there.
    """
    from scipy import ndimage

    nowhere = torch.zeros(points.size, dtype=torch.bool)
    depth = points.depth.double()
    farthest = float(depth.max())
    # They must end sharply: a scene thins out towards the farthest point.
    last = depth >= _END * farthest
    before = (depth >= (2 * _END - 1) * farthest) & ~last
    at_end = int(last.sum())
    if at_end < max(_LEAST_AT_END * len(points), _SHARP * int(before.sum()), 10):
        return nowhere
    # The gaps: pixels too far from any point for their spacing.
    spacing = float(nearest_points(points, points.xy.double(), 2)[0][:, 1].median())
    reach_px = _GAP * spacing
    if (pattern := scan_pattern(points.xy, points.size)) is not None:
        reach_px = max(reach_px, _GAP_LINES * pattern[1])
    pixels = pixels_of(points.size)
    distance, nearest = nearest_points(points, pixels, 1)
    core = (distance.flatten() > reach_px).reshape(points.size)
    if float(core.double().mean()) < _LEAST_GAP:
        return nowhere
    beside = torch.unique(nearest.flatten()[core.flatten()])
    if float(last[beside].double().mean()) < _AT_BORDER:
        return nowhere
    # Around their middle, up to near the points.
    around = ndimage.distance_transform_edt(~core.numpy()) <= _REACHED * reach_px
    return torch.from_numpy(around)
