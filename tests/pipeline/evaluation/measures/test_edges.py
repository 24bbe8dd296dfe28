"""Depth boundaries: steps at known columns, and iBims-1's formulas by brute force."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from pnpdepth_cli.pipeline.evaluation.measured_frame import MeasuredFrame
from pnpdepth_cli.pipeline.evaluation.measures.edges import boundary_errors, edges_of
from scipy.spatial.distance import cdist


def step(column: int) -> np.ndarray:
    depth = np.full((40, 60), 2, np.float32)
    depth[:, column:] = 5
    return depth


def errors(depth: np.ndarray, gt: np.ndarray) -> tuple[float, float]:
    measured = boundary_errors(MeasuredFrame(depth=depth, gt=gt))
    return measured["dbe_accuracy"], measured["dbe_completeness"]


@pytest.mark.parametrize("shift", [0, 1, 4, 9])
def test_a_shifted_step_is_as_far_as_it_is_shifted(shift: int) -> None:
    assert errors(step(30 + shift), step(30)) == pytest.approx((shift, shift))


def test_a_step_beyond_ten_pixels_and_a_missing_one_have_the_largest_error() -> None:
    assert errors(step(50), step(30)) == (10, 10)
    assert errors(np.full((40, 60), 3, np.float32), step(30)) == (10, 10)


def test_an_extra_edge_costs_completeness_alone() -> None:
    extra = step(30)
    extra[:, 50:] = 8
    accuracy, completeness = errors(extra, step(30))
    assert accuracy == 0
    assert completeness == pytest.approx(10 / 3, rel=0.05)  # (0 + 10 + 0) / 3 edges


def test_errors_are_ibims_formulas_over_all_pairs_of_edge_pixels() -> None:
    rng = np.random.default_rng(0)
    noise = (cv2.GaussianBlur(rng.uniform(size=(50, 70)), (0, 0), 3) for _ in range(2))
    gt, depth = (np.where(n > 0.5, 4, 2).astype(np.float32) for n in noise)
    measured = errors(depth, gt)
    own, true = (np.argwhere(edges_of(each)) for each in (depth, gt))
    apart = cdist(own, true)
    to_gt, to_own = apart.min(axis=1), apart.min(axis=0)
    near = to_gt[to_gt < 10]
    both = np.minimum(to_gt, 10).sum() + np.minimum(to_own, 10).sum()
    assert measured == pytest.approx((near.mean(), both / (len(own) + len(true))), rel=1e-5)


def test_holes_make_no_edges_and_sparse_ground_truth_has_none() -> None:
    holes = step(30)
    holes[10:20, 5:15] = 0
    assert errors(holes, step(30)) == (0, 0)
    sparse = np.where(np.random.default_rng(0).random((40, 60)) < 0.1, step(30), 0)
    assert np.isnan(errors(step(30), sparse.astype(np.float32))).all()
