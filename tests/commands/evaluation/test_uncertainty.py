"""Calibration and sparsification against their definitions, and of the files of a refinement."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pnpdepth_cli.commands.evaluation.evaluate import EvalRequest, evaluate
from pnpdepth_cli.commands.evaluation.uncertainty import (
    FrameUncertainty,
    frame_uncertainty,
    summarise_uncertainty,
)
from pnpdepth_cli.io.depth import write_depth


def frame(rng: np.random.Generator, factor: float) -> FrameUncertainty:
    """A frame whose standard deviation is off by a factor."""
    gt = rng.uniform(2, 6, (200, 200)).astype(np.float32)
    sigma = rng.uniform(0.02, 0.2, gt.shape).astype(np.float32)
    depth = (gt + sigma * rng.normal(size=gt.shape)).astype(np.float32)
    result = frame_uncertainty(depth, gt, sigma * np.float32(factor))
    assert result is not None
    return result


def test_a_right_deviation_is_calibrated_and_one_of_half_the_size_is_not() -> None:
    rng = np.random.default_rng(0)
    right = summarise_uncertainty([frame(rng, 1.0) for _ in range(3)])
    half = summarise_uncertainty([frame(rng, 0.5)])
    assert right is not None
    assert half is not None
    assert (right.frames, right.pixels) == (3, 3 * 200 * 200)
    assert right.within_1_sigma == pytest.approx(0.683, abs=0.01)
    assert right.within_2_sigma == pytest.approx(0.954, abs=0.01)
    assert right.observed == pytest.approx(right.expected, abs=0.01)
    assert half.within_1_sigma == pytest.approx(0.383, abs=0.01)


def test_sparsification_is_by_definition() -> None:
    gt = np.full((1, 20), 10, np.float32)
    error = np.arange(1, 21)[None].astype(np.float32)
    sigma = error[:, ::-1].copy()  # the worst possible order
    worst = frame_uncertainty(gt + error, gt, sigma)
    best = frame_uncertainty(gt + error, gt, error)
    assert worst is not None
    assert best is not None
    kept = [error[0, error[0].argsort()][: 20 - n].mean() for n in range(20)]
    assert best.oracle.tolist() == pytest.approx(kept)
    assert best.sparsification.tolist() == pytest.approx(kept)
    assert worst.sparsification.tolist() == pytest.approx([error[0, n:].mean() for n in range(20)])
    total, none = summarise_uncertainty([worst]), summarise_uncertainty([best])
    assert total is not None
    assert none is not None
    area = np.trapezoid(worst.sparsification - worst.oracle, np.arange(20) / 20)
    assert total.ause == pytest.approx(area / error.mean())
    assert none.ause == pytest.approx(0)


def test_the_sigma_beside_a_prediction_is_evaluated(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    gt = rng.uniform(2, 6, (50, 60)).astype(np.float32)
    for folder in ("out", "gt"):
        (tmp_path / folder).mkdir()
    write_depth(tmp_path / "gt" / "a.npy", gt)
    write_depth(tmp_path / "out" / "a_depth.npy", (gt + rng.normal(0, 0.1, gt.shape)).astype("f4"))
    write_depth(tmp_path / "out" / "a_sigma.exr", np.full(gt.shape, 0.1, np.float32))
    request = EvalRequest(prediction=tmp_path / "out", ground_truth=tmp_path / "gt")
    result = evaluate(request)
    assert result.uncertainty is not None
    assert result.uncertainty.within_1_sigma == pytest.approx(0.683, abs=0.03)
    assert result.as_record()["uncertainty"]["frames"] == 1
    assert not any("have no ground truth" in note for note in result.notes)
