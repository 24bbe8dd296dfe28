"""The calibration of a standard deviation by held-out residuals, and the validity mask."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from scipy.interpolate import griddata
from scipy.ndimage import maximum_filter, minimum_filter

from pnpdepth_cli.frames.frame import Refined, Validation
from pnpdepth_cli.frames.uncertainty import (
    beyond_range,
    calibration,
    valid_depth,
    with_uncertainty,
)
from pnpdepth_cli.points import SparsePoints

SAMPLES = Path(__file__).parents[2] / "samples"


def test_without_residuals_the_factor_is_typical_of_the_number_of_points() -> None:
    none = torch.empty(0)
    factors = [calibration(none, none, count) for count in (9, 20, 100, 500, 9999)]
    expected = [1.75 * (count / 100) ** -0.18 for count in (20, 20, 100, 500, 500)]
    assert factors == pytest.approx(expected)


def random_points(count: int, seed: int = 0) -> SparsePoints:
    """Points anywhere in the lower left part of an image of 30 × 40 pixels."""
    rng = np.random.default_rng(seed)
    xy = torch.from_numpy(rng.uniform((2, 8), (30, 28), (count, 2)).astype(np.float32))
    depth = torch.from_numpy(rng.uniform(1, 4, count).astype(np.float32))
    return SparsePoints(xy=xy, depth=depth, size=(30, 40))


def random_map(seed: int, unknown: int = 0) -> np.ndarray:
    depth = np.random.default_rng(seed).uniform(1, 4, (30, 40)).astype(np.float32)
    depth.flat[:unknown] = 0
    return depth


def shape_in_numpy(points: SparsePoints, network: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """The uncalibrated deviation of log depth (H, W), from its description."""
    xy = points.xy.numpy().astype(float)
    log = np.log(points.depth.numpy().astype(float))
    queries = np.stack(np.meshgrid(np.arange(40), np.arange(30)), axis=-1).reshape(-1, 2)
    near = np.linalg.norm(queries[:, None] - xy, axis=2).argsort(axis=1)
    flat = np.log(depth.ravel().astype(float))
    inside = griddata(xy, np.exp(log), queries)
    interpolated = np.log(np.where(np.isnan(inside), np.exp(log[near[:, 0]]), inside))
    own = np.where(network > 0, network, np.sort(network[network > 0])[(network > 0).sum() // 2])
    step = np.log(maximum_filter(own, 9, mode="nearest") / minimum_filter(own, 9, mode="nearest"))
    differences = (
        np.abs(interpolated - flat),
        np.abs(log[near[:, :3]].mean(axis=1) - flat),
        np.ptp(log[near[:, :8]], axis=1),
        step.ravel(),
    )
    powers = zip(differences, (0.58, 0.10, 0.42, 0.18), strict=True)
    return np.prod([(scale + 0.003) ** power for scale, power in powers], axis=0).reshape(30, 40)


def factor_in_numpy(residual: np.ndarray, sigma: np.ndarray, count: int) -> float:
    """The calibration of finite residuals, from its description."""
    typical = 1.75 * (np.clip(count, 20, 500) / 100) ** -0.18
    ratio = np.sort(np.abs(residual) / sigma)
    total = len(residual)
    one, two = (ratio[min(int(np.ceil(p * (total + 1))), total) - 1] for p in (0.68, 0.95))
    share = total / (total + 20)
    factor = (one**0.25 * (two / 2) ** 0.75) ** share * typical ** (1 - share)
    return float(np.clip(factor, 0.01, 1000))


@pytest.mark.parametrize("count", [5, 60])
def test_the_deviation_is_the_calibrated_product_of_four_differences(count: int) -> None:
    kept = random_points(count)
    whole = random_points(count, seed=1)
    network = random_map(2, unknown=7)
    depth = random_map(3)
    rng = np.random.default_rng(4)
    xy = np.column_stack([rng.integers(0, 40, 30), rng.integers(0, 30, 30)])
    truth = replace(
        random_points(30, seed=5), xy=torch.from_numpy(xy).float(), depth=torch.rand(30) + 1
    )
    predicted = depth[xy[:, 1], xy[:, 0]].copy()
    weights = rng.uniform(0.06, 1, 30)
    # unknown or an outlier: these do not calibrate
    predicted[:3] = 0
    weights[3:6] = (0.03, 0.04, 0.05)
    validation = Validation(
        points=truth, kept=kept, network=torch.from_numpy(network),
        weights=torch.from_numpy(weights), predicted={"after": torch.from_numpy(predicted)},
    )  # fmt: skip
    frame = Refined(
        before=network, depth=depth, used=whole, losses=(), step=0.0, diverged=None,
        propagation="gp", validation=validation,
    )  # fmt: skip
    sigma = shape_in_numpy(kept, network, depth)[xy[6:, 1], xy[6:, 0]]
    residual = np.log(truth.depth.numpy()[6:] / predicted[6:])
    shape = shape_in_numpy(whole, network, depth)
    shared = 0.0 if count == 5 else 0.01  # of a map's points, less than 10 pixels apart
    expected = np.hypot(factor_in_numpy(residual, sigma, count) * shape, shared) * depth
    found = with_uncertainty(frame)
    np.testing.assert_allclose(found.sigma, expected, rtol=1e-4)
    assert "24 validation points" in found.notes[0]


@pytest.mark.parametrize("scale", [1e-9, 0.3, 1e9])
@pytest.mark.parametrize(("total", "count"), [(1, 10), (7, 90), (200, 700)])
def test_the_calibration_is_of_the_ranks_of_residuals(scale: float, total: int, count: int) -> None:
    residual, sigma = np.random.default_rng(total).uniform(0.1, 2, (2, total)) * [[scale], [1]]
    none = torch.tensor([torch.nan, 1.0, torch.inf])
    found = calibration(
        torch.cat([torch.from_numpy(residual), none]),
        torch.cat([torch.from_numpy(sigma), torch.tensor([1.0, 0.0, 1.0])]), count,
    )  # fmt: skip
    assert found == pytest.approx(factor_in_numpy(residual, sigma, count))


def test_depth_is_valid_near_the_hull_of_the_points_up_to_its_limits() -> None:
    points = random_points(40)
    depth = random_map(6)
    most = 1.5 * float(points.depth.max())
    sigma = 0.24 * depth
    depth[15, 10:16] = most, most * 1.001, 0, 2, 2, 0.5
    sigma[15, 10:16] = 0.1, 0.1, 0, 0.5, 0.501, 0.1
    found = valid_depth(points, torch.from_numpy(depth), torch.from_numpy(sigma)).numpy()
    xy = points.xy.numpy()
    pixels = np.stack(np.meshgrid(np.arange(40), np.arange(30)), axis=-1)
    hull = cv2.convexHull(xy)[:, 0].astype(float)
    along = np.roll(hull, -1, axis=0) - hull
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    signed = ((pixels[..., None, :] - hull) * along[:, ::-1] * (-1, 1)).sum(axis=-1)
    inside = (np.sign(np.median(signed)) * signed >= -0.25).all(axis=2)
    gap = np.linalg.norm(pixels[..., None, :] - xy, axis=3).min(axis=2)
    near = inside | (gap <= 2 * np.quantile(gap[inside], 0.95))
    supported = (depth > 0) & (depth <= np.float32(most)) & (sigma <= 0.25 * depth)
    assert 0.2 < near.mean() < 0.9
    np.testing.assert_array_equal(found, near & supported)


def sampled(depth: np.ndarray, most: float, seed: int = 0) -> SparsePoints:
    """400 random points of the pixels up to a depth."""
    rows, columns = np.nonzero(depth <= most)
    chosen = np.random.default_rng(seed).permutation(len(rows))[:400]
    xy = np.column_stack([columns, rows])[chosen].astype(np.float32)
    of_points = depth[rows, columns][chosen].astype(np.float32)
    size = (depth.shape[0], depth.shape[1])
    return SparsePoints(xy=torch.from_numpy(xy), depth=torch.from_numpy(of_points), size=size)


@pytest.mark.parametrize("seed", range(4))
def test_gaps_of_points_that_end_at_one_depth_are_beyond_the_sensors_range(seed: int) -> None:
    y, x = np.mgrid[:120, :160]
    room = 2.0 + 4.0 * np.hypot(x - 80, y - 60) / 100  # it is farther away from the middle
    depth = np.where(x < 60, 8.0 - room, room)
    found = beyond_range(sampled(depth, 4.0, seed)).numpy()
    far = depth > 4.0
    assert (found & far).sum() > 0.8 * far.sum()
    assert (found & ~far).sum() < 0.2 * (~far).sum()
    assert not beyond_range(sampled(depth, 99.0, seed)).any()  # all is within the range
    wall = np.full(depth.shape, 4.0)
    assert not beyond_range(sampled(wall, 99.0, seed)).any()  # the farthest is a surface


@pytest.mark.parametrize("farthest_m", [2.0, 3.0, 4.0, 5.0])
def test_a_room_beyond_a_sensors_range_is_found(farthest_m: float) -> None:
    room = cv2.imread(str(SAMPLES / "indoor" / "gt.png"), cv2.IMREAD_UNCHANGED) / 1000
    beyond = room > farthest_m
    for seed in range(3):
        found = beyond_range(sampled(room, farthest_m, seed)).numpy()
        assert (found & beyond).sum() > 0.75 * beyond.sum()
        assert (found & ~beyond).sum() < 0.2 * beyond.size
        assert not beyond_range(sampled(room, 99.0, seed)).any()
