"""Scaling of relative predictions by the papers' reference codes, and crops that do not fit."""

from __future__ import annotations

import numpy as np
import pytest

from pnpdepth_cli.commands.evaluation.scoring import crop_window, scale_prediction
from pnpdepth_cli.errors import InputError

RNG = np.random.default_rng(0)
GT = RNG.uniform(1, 9, (40, 50)).astype(np.float32)
TRUTH = np.where(RNG.random(GT.shape) < 0.7, GT, 0)
"""The ground truth where it is known."""


@pytest.mark.parametrize("scale_by", ["median", "affine", "affine-disparity"])
def test_a_fit_is_that_of_monodepth2_marigold_or_midas(scale_by: str) -> None:
    target = 1 / GT if scale_by == "affine-disparity" else GT
    predicted = ((target - 0.05) / 3 + RNG.normal(0, 0.002, GT.shape)).astype(np.float32)
    predicted[:3] = 0  # unknown
    both = (TRUTH > 0) & (predicted > 0)
    if scale_by == "median":
        # evaluate_depth.py: ratio = np.median(gt_depth) / np.median(pred_depth), both masked
        s = np.median(GT[both]) / np.median(predicted[both])
        t = 0.0
    else:
        a = np.stack([predicted[both], np.ones(both.sum())], axis=1).astype(np.float64)
        (s, t), *_ = np.linalg.lstsq(a, target[both].astype(np.float64), rcond=None)
    depth, fit = scale_prediction(predicted, TRUTH, scale_by)
    assert fit == pytest.approx((s, t), rel=1e-5)
    assert not depth[:3].any()
    fitted = np.maximum(s * predicted + t, 0)[3:]
    expected = 1 / fitted if scale_by == "affine-disparity" else fitted
    assert depth[3:] == pytest.approx(expected, rel=1e-4, abs=1e-6)


def test_a_constant_prediction_too_few_pixels_and_too_small_a_frame_are_refused() -> None:
    with pytest.raises(InputError, match="constant"):
        scale_prediction(np.ones_like(GT), GT, "affine")
    with pytest.raises(InputError, match="needs 2 pixels"):
        scale_prediction(GT, np.zeros_like(GT), "median")
    with pytest.raises(InputError, match=r"640×480 but this one is 304×228"):
        crop_window("nyu", (228, 304))


@pytest.mark.parametrize("crop", ["garg", "eigen"])
def test_frames_that_were_cut_have_the_crop_of_the_whole_frame(crop: str) -> None:
    whole = np.zeros((375, 1242), bool)
    whole[crop_window(crop, whole.shape)] = True
    cut = np.zeros((352, 1216), bool)
    cut[crop_window(crop, cut.shape)] = True
    np.testing.assert_array_equal(cut, whole[375 - 352 :, 13:-13])
