"""Chamfer distance and F-score by all pairs of points."""

from __future__ import annotations

import numpy as np
import pytest
from pnpdepth_cli.pipeline.evaluation.measured_frame import MeasuredFrame
from pnpdepth_cli.pipeline.evaluation.measures.cloud import cloud_errors
from scipy.spatial.distance import cdist

from tests.pipeline.evaluation.measures.frames import K, random_frame


def test_chamfer_and_f_score_are_those_of_all_pairs() -> None:
    frame = random_frame(0)
    y, x = np.nonzero((frame.depth > 0) & (frame.gt > 0))
    clouds = []
    for depth in (frame.depth, frame.gt):
        z = depth[y, x].astype(float)
        clouds.append(np.stack([z * (x - 20) / 50, z * (y - 15) / 60, z], axis=1))
    apart = cdist(*clouds)
    accuracy, completeness = apart.min(axis=1), apart.min(axis=0)
    precision, recall = ((d < 0.1).mean() for d in (accuracy, completeness))
    errors = cloud_errors(frame)
    assert errors["chamfer"] == pytest.approx((accuracy.mean() + completeness.mean()) / 2)
    assert errors["f_score"] == pytest.approx(2 * precision * recall / (precision + recall))


def test_the_ground_truth_itself_is_perfect_and_nothing_is_none() -> None:
    gt = random_frame(1).gt
    errors = cloud_errors(MeasuredFrame(depth=gt, gt=gt, intrinsics=K))
    assert (errors["chamfer"], errors["f_score"]) == (0, 1)
    none = cloud_errors(MeasuredFrame(depth=np.zeros_like(gt), gt=gt, intrinsics=K))
    assert np.isnan(list(none.values())).all()
