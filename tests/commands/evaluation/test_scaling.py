"""Scaling of relative predictions, against the reference codes of the papers written in NumPy."""

from __future__ import annotations

import numpy as np
import pytest

from pnpdepth_cli.commands.evaluation.scaling import scaled
from pnpdepth_cli.errors import InputError

RNG = np.random.default_rng(0)
GT = RNG.uniform(1, 9, (40, 50)).astype(np.float32)


@pytest.fixture
def where() -> np.ndarray:
    """True where the ground truth is known."""
    return RNG.random(GT.shape) < 0.7


def test_without_scaling_disparity_becomes_depth_and_nothing_else() -> None:
    disparity = (1 / GT).astype(np.float32)
    disparity[0, 0] = 0
    depth, fit = scaled(disparity, GT, "disparity", "none")
    assert fit is None
    assert depth[0, 0] == 0
    assert depth[1:] == pytest.approx(GT[1:], rel=1e-6)


def test_median_is_that_of_monodepth2(where: np.ndarray) -> None:
    predicted = (GT * RNG.uniform(0.2, 0.4, GT.shape)).astype(np.float32)
    # evaluate_depth.py: ratio = np.median(gt_depth) / np.median(pred_depth), both masked
    ratio = np.median(GT[where]) / np.median(predicted[where])
    depth, fit = scaled(predicted, np.where(where, GT, 0), "depth", "median")
    assert fit is not None
    assert fit.factor == pytest.approx(ratio, rel=1e-6)
    assert depth == pytest.approx(predicted * ratio, rel=1e-6)


def test_affine_disparity_is_that_of_midas(where: np.ndarray) -> None:
    disparity = (3 / GT + 0.5 + RNG.normal(0, 0.01, GT.shape)).astype(np.float32)
    # MiDaS's compute_scale_and_shift: the normal equations of s·p + t = 1/g
    a = np.stack([disparity[where], np.ones(where.sum())], axis=1).astype(np.float64)
    (s, t), *_ = np.linalg.lstsq(a, 1 / GT[where].astype(np.float64), rcond=None)
    depth, fit = scaled(disparity, np.where(where, GT, 0), "disparity", "affine-disparity")
    assert fit is not None
    assert (fit.factor, fit.shift) == pytest.approx((s, t), rel=1e-6)
    assert depth == pytest.approx(1 / (s * disparity + t), rel=1e-4)


def test_affine_is_that_of_marigold(where: np.ndarray) -> None:
    predicted = ((GT - 0.5) / 20 + RNG.normal(0, 0.001, GT.shape)).astype(np.float32)
    # Marigold's align_depth_least_square: lstsq of [pred, 1] to the ground truth
    a = np.stack([predicted[where], np.ones(where.sum())], axis=1).astype(np.float64)
    (s, t), *_ = np.linalg.lstsq(a, GT[where].astype(np.float64), rcond=None)
    depth, fit = scaled(predicted, np.where(where, GT, 0), "depth", "affine")
    assert fit is not None
    assert (fit.factor, fit.shift) == pytest.approx((s, t), rel=1e-5)
    assert depth == pytest.approx(np.maximum(s * predicted + t, 0), rel=1e-4, abs=1e-6)


def test_log_leaves_no_mean_error_of_the_logarithm(where: np.ndarray) -> None:
    predicted = (GT * RNG.lognormal(1, 0.2, GT.shape)).astype(np.float32)
    depth, _ = scaled(predicted, np.where(where, GT, 0), "depth", "log")
    assert np.mean(np.log(depth[where]) - np.log(GT[where])) == pytest.approx(0, abs=1e-6)


def test_empty_predictions_stay_empty_and_are_not_fitted() -> None:
    predicted = GT / 2
    predicted[:, :10] = 0
    depth, fit = scaled(predicted, GT, "depth", "median")
    assert fit is not None
    assert fit.factor == pytest.approx(2)
    assert not depth[:, :10].any()


def test_a_constant_prediction_and_too_few_pixels_are_refused() -> None:
    with pytest.raises(InputError, match="constant"):
        scaled(np.ones_like(GT), GT, "depth", "affine")
    with pytest.raises(InputError, match="needs 2 pixels"):
        scaled(GT, np.zeros_like(GT), "depth", "median")
