"""Scores against values worked out by hand and against plain numpy."""

from __future__ import annotations

from dataclasses import asdict
from math import isnan, log, sqrt

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from pnpdepth_cli.core.metrics import score


def test_two_pixels_by_hand() -> None:
    scores = score(torch.tensor([[2.0, 3.0]]), torch.tensor([[1.0, 4.0]]))
    assert scores.rmse == 1
    assert scores.mae == 1
    assert scores.mre == (1 + 0.25) / 2
    assert (scores.delta1, scores.delta2, scores.delta3) == (0, 0.5, 0.5)
    assert scores.irmse == pytest.approx(1000 * sqrt((0.5**2 + (1 / 12) ** 2) / 2))
    a, b = log(2), log(0.75)
    assert scores.silog == pytest.approx(100 * abs(a - b) / 2)
    assert (scores.pixels, scores.coverage) == (2, 1)


def brute(predicted: np.ndarray, truth: np.ndarray) -> dict[str, float]:
    pairs = [
        (float(p), float(g))
        for p, g in zip(predicted.ravel(), truth.ravel(), strict=True)
        if np.isfinite(p) and p > 0 and np.isfinite(g) and g > 0
    ]
    known = sum(1 for g in truth.ravel() if np.isfinite(g) and g > 0)
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
        "pixels": n,
        "coverage": n / known,
    }


depths = st.one_of(
    st.floats(0.125, 100, width=32), st.sampled_from([0.0, -1.0, np.nan, np.inf, -np.inf])
)


@given(st.lists(st.tuples(depths, depths), min_size=1, max_size=40))
def test_scores_are_those_of_plain_numpy(pairs: list[tuple[float, float]]) -> None:
    predicted, truth = np.array([(2.0, 3.0), *pairs], np.float32).T
    scores = score(torch.from_numpy(predicted.copy()), torch.from_numpy(truth.copy()))
    expected = brute(predicted, truth)
    assert asdict(scores) == {
        name: pytest.approx(value, rel=1e-9, abs=1e-5) for name, value in expected.items()
    }


def test_a_perfect_prediction_scores_perfectly() -> None:
    truth = torch.rand(3, 4) + 1
    scores = score(truth, truth)
    assert (scores.rmse, scores.mae, scores.mre, scores.irmse, scores.silog) == (0, 0, 0, 0, 0)
    assert (scores.delta1, scores.coverage) == (1, 1)


def test_a_scale_alone_is_no_error_of_silog() -> None:
    truth = torch.rand(50) + 1
    assert score(truth * 3, truth).silog == pytest.approx(0, abs=1e-4)


def test_half_a_prediction_is_half_the_coverage() -> None:
    scores = score(torch.tensor([1.0, 0.0, 5.0]), torch.tensor([1.0, 1.0, 0.0]))
    assert (scores.pixels, scores.coverage, scores.rmse) == (1, 0.5, 0)


def test_nothing_to_score_is_not_a_number() -> None:
    scores = score(torch.zeros(2, 2), torch.zeros(2, 2))
    assert scores.pixels == 0
    assert isnan(scores.rmse)
    assert isnan(scores.coverage)
    assert score(torch.zeros(2), torch.ones(2)).coverage == 0


def test_a_ratio_on_the_threshold_is_not_below_it() -> None:
    assert score(torch.tensor([1.25]), torch.tensor([1.0])).delta1 == 0
    assert score(torch.tensor([0.8 + 1e-6]), torch.tensor([1.0])).delta1 == 1
