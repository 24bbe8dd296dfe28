"""Additional measures: on steps, and by all pairs of points."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy.spatial.distance import cdist

from pnpdepth_cli.choices import MEASURE_GROUPS
from pnpdepth_cli.commands.evaluation.measures import MeasuredFrame, edges_of


def values(name: str, frame: MeasuredFrame) -> dict[str, float]:
    group = MEASURE_GROUPS[name]
    keys = [measure.key for measure in group.measures]
    return dict(zip(keys, group.values(frame), strict=True))


def step(column: int) -> np.ndarray:
    depth = np.full((40, 60), 2, np.float32)
    depth[:, column:] = 5
    return depth


def edge_errors(depth: np.ndarray, gt: np.ndarray) -> tuple[float, ...]:
    return tuple(values("edges", MeasuredFrame(depth=depth, gt=gt)).values())


@pytest.mark.parametrize(
    ("column", "error"), [(30, 0), (31, 1), (34, 4), (39, 9), (50, 10), (60, 10)]
)
def test_a_shifted_step_is_as_far_as_it_is_shifted_up_to_ten_pixels(
    column: int, error: int
) -> None:
    assert edge_errors(step(column), step(30)) == pytest.approx((error, error))
    far = edge_errors(18 + step(column), 18 + step(30))
    assert far == pytest.approx((error, error))


def test_an_extra_edge_costs_completeness_alone_and_holes_make_none() -> None:
    extra = step(30)
    extra[:, 50:] = 8
    accuracy, completeness = edge_errors(extra, step(30))
    assert accuracy == 0
    assert completeness == pytest.approx(10 / 3, rel=0.05)  # (0 + 10 + 0) / 3 edges
    holes = step(30)
    holes[10:20, 5:15] = 0
    assert edge_errors(holes, step(30)) == (0, 0)
    holes[:, 28:38] = 0  # where the edge was is not known
    assert edge_errors(holes, step(30)) == (10, 10)
    assert np.isnan(edge_errors(np.zeros_like(holes), step(30))).all()
    rough = step(30)
    rough[:, :20] += np.random.default_rng(0).uniform(0, 0.02, (40, 20)).astype(np.float32)
    assert edge_errors(rough, step(30)) == (0, 0)
    sparse = np.where(np.random.default_rng(0).random((40, 60)) < 0.1, step(30), 0)
    assert np.isnan(edge_errors(step(30), sparse.astype(np.float32))).all()
    assert np.isnan(edge_errors(step(30), np.full((40, 60), 2, np.float32))).all()


def test_boundary_errors_are_ibims_formulas_over_all_pairs_of_edge_pixels() -> None:
    rng = np.random.default_rng(0)
    noise = (cv2.GaussianBlur(rng.uniform(size=(50, 70)), (0, 0), 3) for _ in range(2))
    gt, depth = (np.where(n > 0.5, 4, 2).astype(np.float32) for n in noise)
    own, true = (np.argwhere(edges_of(each)) for each in (depth, gt))
    apart = cdist(own, true)
    to_gt, to_own = apart.min(axis=1), apart.min(axis=0)
    near = to_gt[to_gt < 10]
    both = np.minimum(to_gt, 10).sum() + np.minimum(to_own, 10).sum()
    expected = near.mean(), both / (len(own) + len(true))
    assert edge_errors(depth, gt) == pytest.approx(expected, rel=1e-5)
