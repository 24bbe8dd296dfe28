"""Scaling of relative predictions by the papers' reference codes, and standard deviations."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pnpdepth_cli.commands.evaluation.eval_request import EvalRequest
from pnpdepth_cli.commands.evaluation.evaluate import evaluate
from pnpdepth_cli.commands.evaluation.scoring import scale_prediction
from pnpdepth_cli.errors import InputError
from pnpdepth_cli.io.depth import write_depth

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
        s, t = np.median(GT[both]) / np.median(predicted[both]), 0.0
    else:
        a = np.stack([predicted[both], np.ones(both.sum())], axis=1).astype(np.float64)
        (s, t), *_ = np.linalg.lstsq(a, target[both].astype(np.float64), rcond=None)
    depth, fit = scale_prediction(predicted, TRUTH, scale_by)
    assert fit == pytest.approx((s, t), rel=1e-5)
    assert not depth[:3].any()
    fitted = np.maximum(s * predicted + t, 0)[3:]
    expected = 1 / fitted if scale_by == "affine-disparity" else fitted
    assert depth[3:] == pytest.approx(expected, rel=1e-4, abs=1e-6)


def test_a_constant_prediction_and_too_few_pixels_are_refused() -> None:
    with pytest.raises(InputError, match="constant"):
        scale_prediction(np.ones_like(GT), GT, "affine")
    with pytest.raises(InputError, match="needs 2 pixels"):
        scale_prediction(GT, np.zeros_like(GT), "median")


def test_the_sigma_beside_a_prediction_is_evaluated(tmp_path: Path) -> None:
    for folder in ("out", "gt"):
        (tmp_path / folder).mkdir()
    write_depth(tmp_path / "gt" / "a.npy", GT)
    write_depth(tmp_path / "out" / "a_depth.npy", (GT + RNG.normal(0, 0.1, GT.shape)).astype("f4"))
    write_depth(tmp_path / "out" / "a_sigma.npy", np.full(GT.shape, 0.1, np.float32))
    result = evaluate(EvalRequest(prediction=tmp_path / "out", ground_truth=tmp_path / "gt"))
    assert result.mean["within_1_sigma"] == pytest.approx(0.683, abs=0.03)
    assert not any("have no ground truth" in note for note in result.notes)
    write_depth(tmp_path / "out" / "a_sigma.npy", np.ones((2, 2), np.float32))
    with pytest.raises(InputError, match=r"a_sigma\.npy"):
        evaluate(result.request)
