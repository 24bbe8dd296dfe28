"""Order, ratio and spread of two depths of the same pixels."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import spearmanr

from pnpdepth_cli.completion.two_depths import compare_depths, is_reversed

RNG = np.random.default_rng(0)
DEPTH = RNG.uniform(1, 60, (40, 50)).astype(np.float32)
NOISY = DEPTH * np.exp(RNG.normal(0, 0.05, DEPTH.shape)).astype(np.float32)


def test_the_ratio_and_its_spread_are_those_of_what_was_multiplied() -> None:
    found = compare_depths(3 * NOISY, DEPTH)
    assert found.pairs == DEPTH.size
    assert found.ratio == pytest.approx(3, rel=0.01)
    assert found.spread == pytest.approx(0.05, rel=0.1)
    assert found.rank > 0.98
    assert compare_depths(1 / NOISY, DEPTH).rank < -0.98
    assert compare_depths(np.zeros(5), np.ones(5)).pairs == 0


@pytest.mark.parametrize("factor", [0.0254, 0.3048, 1 / 3.906, 2.0, 3.906, 10.0, 1000.0])
def test_a_tight_ratio_is_a_unit(factor: float) -> None:
    assert compare_depths(factor * NOISY, DEPTH).is_unit


@pytest.mark.parametrize(
    ("first", "why"),
    [
        (NOISY, "nothing differs"),
        (1.4 * NOISY, "noise may explain it"),
        (386 / NOISY, "disparity"),
        (5 * RNG.permuted(DEPTH), "another frame"),
        (0.2 * NOISY + 8, "a scale and a shift"),
        (np.where(np.arange(2000).reshape(40, 50) < 9, 5 * NOISY, 0), "too few"),
    ],
)
def test_no_other_difference_is_a_unit(first: np.ndarray, why: str) -> None:
    assert not compare_depths(first, DEPTH).is_unit


def test_the_rank_correlation_is_spearmans_also_of_equal_depths() -> None:
    first = RNG.integers(1, 9, 500).astype(float)
    second = first + RNG.integers(0, 5, 500)
    assert compare_depths(first, second).rank == pytest.approx(spearmanr(first, second).statistic)


def test_a_rank_correlation_is_reversed_only_where_chance_does_not_explain_it() -> None:
    assert is_reversed(-0.9, 100)
    assert not is_reversed(-0.9, 10)
    assert not is_reversed(-0.4, 10_000)
    assert not is_reversed(0.9, 100)
