"""Scores against values worked out by hand and against plain numpy."""

from __future__ import annotations

import pickle
from math import isnan, log, sqrt

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from pnpdepth_cli.core.metrics import score
from pnpdepth_cli.measures import MEASURES


def brute(predicted: np.ndarray, gt: np.ndarray) -> dict[str, float]:
    pairs = [
        (float(p), float(g))
        for p, g in zip(predicted.ravel(), gt.ravel(), strict=True)
        if np.isfinite(p) and p > 0 and np.isfinite(g) and g > 0
    ]
    known = sum(1 for g in gt.ravel() if np.isfinite(g) and g > 0)
    n = len(pairs)
    logs = [log(p) - log(g) for p, g in pairs]
    ratios = [max(p / g, g / p) for p, g in pairs]
    return {
        "rmse": sqrt(sum((p - g) ** 2 for p, g in pairs) / n),
        "mae": sum(abs(p - g) for p, g in pairs) / n,
        "mre": sum(abs(p - g) / g for p, g in pairs) / n,
        **{f"delta{k}": sum(r < 1.25**k for r in ratios) / n for k in (1, 2, 3)},
        "irmse": 1000 * sqrt(sum((1 / p - 1 / g) ** 2 for p, g in pairs) / n),
        "silog": 100 * float(np.std(logs)),
        "sq_rel": sum((p - g) ** 2 / g for p, g in pairs) / n,
        "log10": sum(abs(np.log10(p) - np.log10(g)) for p, g in pairs) / n,
        "rmse_log": sqrt(sum(e**2 for e in logs) / n),
        "imae": 1000 * sum(abs(1 / p - 1 / g) for p, g in pairs) / n,
        "pixels": n,
        "coverage": n / known,
    }


depths = st.one_of(
    st.floats(0.125, 100, width=32), st.sampled_from([0.0, -1.0, np.nan, np.inf, -np.inf])
)


@settings(max_examples=40, deadline=None)
@given(st.lists(st.tuples(depths, depths), min_size=1, max_size=40))
def test_scores_are_those_of_plain_numpy(pairs: list[tuple[float, float]]) -> None:
    predicted, gt = np.array([(2.0, 3.0), *pairs], np.float32).T
    scores = score(torch.from_numpy(predicted.copy()), torch.from_numpy(gt.copy()))
    expected = brute(predicted, gt)
    assert scores.to_json() == {
        name: pytest.approx(value, rel=1e-9, abs=1e-5) for name, value in expected.items()
    }


def test_nothing_to_score_is_not_a_number() -> None:
    scores = score(torch.zeros(2, 2), torch.zeros(2, 2))
    assert scores.pixels == 0
    assert isnan(scores.rmse)
    assert isnan(scores.coverage)
    assert score(torch.zeros(2), torch.ones(2)).coverage == 0


def test_every_measure_is_a_score_with_a_unit() -> None:
    scores = score(torch.ones(2), torch.ones(2))
    assert [*scores.to_json()] == [*(m.key for m in MEASURES), "pixels", "coverage"]
    assert scores.delta3 == 1
    with pytest.raises(AttributeError):
        _ = scores.delta4
    assert pickle.loads(pickle.dumps(scores)) == scores
    units = {measure.key: measure.unit for measure in MEASURES}
    assert {key for key, unit in units.items() if unit == "m"} == {"rmse", "mae", "sq_rel"}
    assert {key for key, unit in units.items() if unit == "1/km"} == {"irmse", "imae"}
    assert [m.key for m in MEASURES if m.better == "higher"] == ["delta1", "delta2", "delta3"]


def test_the_thresholds_of_delta_can_be_the_papers_kitti_ones() -> None:
    predicted, gt = torch.tensor([1.009, 1.015, 1.025, 1.04]), torch.ones(4)
    scores = score(predicted, gt, (1.01, 1.01**2, 1.01**3))
    assert (scores.delta1, scores.delta2, scores.delta3) == (0.25, 0.5, 0.75)
