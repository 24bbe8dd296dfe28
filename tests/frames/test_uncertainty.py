"""The calibration of a standard deviation by held-out residuals, and the validity mask."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

import pnpdepth_cli as pnp
from pnpdepth_cli.frames.uncertainty import calibration, valid_depth
from pnpdepth_cli.io.depth import read_depth
from pnpdepth_cli.points import SparsePoints

INDOOR = Path(__file__).parents[2] / "samples" / "indoor"


def test_normal_residuals_are_calibrated_to_their_standard_deviation() -> None:
    residual = torch.randn(20000, generator=torch.Generator().manual_seed(0)) * 3
    factor = calibration(residual, torch.ones(20000), 500)
    assert factor == pytest.approx(3, rel=0.03)
    assert calibration(2 * residual, torch.ones(20000), 500) == pytest.approx(2 * factor, rel=1e-3)


def test_few_residuals_are_averaged_with_the_typical_factor() -> None:
    ones = torch.ones(20)
    alone = calibration(ones[:0], ones[:0], 100)
    assert alone == pytest.approx(1.75)
    assert calibration(ones[:0], ones[:0], 20) > alone > calibration(ones[:0], ones[:0], 500)
    assert calibration(ones[:0], ones[:0], 9999) == calibration(ones[:0], ones[:0], 500)
    of_residuals = 7 * 0.5**0.75  # all ratios are 7: 68 % within 7 σ, 95 % within 2 · 3.5 σ
    assert calibration(7 * ones, ones, 100) == pytest.approx((of_residuals * alone) ** 0.5)


def test_heavy_tails_are_between_the_factors_of_one_and_of_two_sigma() -> None:
    generator = torch.Generator().manual_seed(0)
    residual = torch.randn(20000, generator=generator) / torch.rand(20000, generator=generator)
    factor = calibration(residual, torch.ones(20000), 500)
    for sigmas in (1, 2):
        assert 0.68 < float((residual.abs() <= sigmas * factor).double().mean()) < 0.95


def lidar_points() -> SparsePoints:
    """Scan lines in the lower half of an image of 60 × 100 pixels, 5 to 20 m away."""
    y, x = torch.meshgrid(torch.arange(30, 60, 4), torch.arange(0, 100, 2), indexing="ij")
    xy = torch.stack([x.flatten(), y.flatten()], dim=1).float()
    return SparsePoints(xy=xy, depth=torch.linspace(20, 5, len(xy)), size=(60, 100))


def test_the_sky_above_scan_lines_is_not_valid() -> None:
    depth = torch.full((60, 100), 10.0)
    valid = valid_depth(lidar_points(), depth, torch.full_like(depth, 0.1))
    assert not valid[:20].any()
    assert valid[30:59].all()


def test_depth_beyond_the_points_or_too_uncertain_is_not_valid() -> None:
    depth = torch.full((60, 100), 10.0)
    sigma = torch.full_like(depth, 0.1)
    depth[40, 10], depth[40, 11], sigma[40, 12] = 0, 31, 2.6
    valid = valid_depth(lidar_points(), depth, sigma)
    assert valid[40, 9:14].tolist() == [True, False, False, False, True]


def test_the_deviation_of_a_dense_map_holds_an_error_that_its_points_share() -> None:
    rgb = cv2.cvtColor(cv2.imread(str(INDOOR / "rgb.png")), cv2.COLOR_BGR2RGB)
    truth = read_depth(INDOOR / "gt.png").values
    wave = np.random.default_rng(0).normal(size=(4, 5)).astype(np.float32)
    wave = cv2.resize(wave, truth.shape[::-1], interpolation=cv2.INTER_CUBIC)
    measured = np.zeros_like(truth)
    measured[2::4, 2::4] = (truth * (1 + 0.01 * wave / wave.std()))[2::4, 2::4]
    settings = pnp.Settings(iterations=0)
    with pnp.Refiner(pnp.load_network("compact"), settings, uncertainty=True) as refiner:
        refined = refiner.refine(rgb, measured)
    assert refined.sigma is not None
    error = np.abs(refined.after - truth)[truth > 0]
    assert (error <= 2 * refined.sigma[truth > 0]).mean() > 0.85  # 0.2 without the sensor's
