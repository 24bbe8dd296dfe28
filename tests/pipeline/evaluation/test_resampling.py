"""Intervals and p-values against textbooks, scipy.stats and brute force; Holm by hand."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from pnpdepth_cli.core.metrics import SUMS
from pnpdepth_cli.pipeline.evaluation.resampling import (
    FrameTable,
    clusters_among,
    holm,
    known_together,
    sign_flip_p_values,
    studentised_interval,
)


def interval(
    rows: np.ndarray, resamples: int, seed: int = 0, clusters: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    table = FrameTable(rows=rows)
    ids = np.arange(len(rows)) if clusters is None else clusters
    return studentised_interval(table.means_of, table.cluster_totals(ids), resamples, seed)


def test_the_interval_is_the_textbooks_for_many_frames() -> None:
    rows = np.random.default_rng(1).normal(5, 2, size=(400, 1))
    low, high = interval(rows, 4000)
    standard_error = rows.std() / np.sqrt(400)
    assert low[0] == pytest.approx(rows.mean() - 1.96 * standard_error, abs=0.1 * standard_error)
    assert high[0] == pytest.approx(rows.mean() + 1.96 * standard_error, abs=0.1 * standard_error)


def test_each_end_is_the_farther_one_of_bootstrap_t_and_students_t() -> None:
    values = np.random.default_rng(2).lognormal(0, 0.5, 9)
    drawn = values[np.random.default_rng(7).integers(0, 9, (3000, 9), dtype=np.int32)]
    with np.errstate(divide="ignore", invalid="ignore"):
        ratios = (drawn.mean(axis=1) - values.mean()) / (drawn.std(axis=1) / 3)
    ratios = ratios[drawn.std(axis=1) > 1e-6]
    low, high = np.quantile(ratios, [0.025, 0.975])
    own = values.std() / 3
    bootstrap = (values.mean() - high * own, values.mean() - low * own)
    student = stats.t.interval(0.95, 8, loc=values.mean(), scale=stats.sem(values))
    expected = (min(bootstrap[0], student[0]), max(bootstrap[1], student[1]))
    assert expected == pytest.approx((student[0], bootstrap[1]))  # the errors are skewed
    bounds = interval(values[:, None], 3000, seed=7)
    assert np.ravel(bounds) == pytest.approx(expected, rel=1e-9)


def test_the_standard_error_of_a_pooled_measure_is_the_delta_methods() -> None:
    sums = np.random.default_rng(3).uniform(1, 2, (300, len(SUMS)))
    table = FrameTable(rows=sums, pooled=True)
    low, high = studentised_interval(table.means_of, table.cluster_totals(np.arange(300)), 4000, 0)
    squared, pixels = sums[:, SUMS.index("squared")], sums[:, SUMS.index("pixels")]
    mean = squared.sum() / pixels.sum()
    error = np.sqrt(((squared - mean * pixels) ** 2).sum()) / pixels.sum() / (2 * np.sqrt(mean))
    assert (high[0] - low[0]) / 2 == pytest.approx(1.96 * error, rel=0.05)


def test_clusters_of_equal_frames_are_as_sure_as_one_frame_each() -> None:
    values = np.random.default_rng(2).lognormal(0, 0.5, (9, 1))
    repeated = np.repeat(values, 20, axis=0)
    ids = np.repeat(np.arange(9), 20)
    assert np.ravel(interval(repeated, 500, clusters=ids)) == pytest.approx(
        np.ravel(interval(values, 500))
    )


def test_lognormal_errors_of_eight_frames_are_covered() -> None:
    draws = np.random.default_rng(0).lognormal(-0.125, 0.5, (30, 8, 20))  # of mean 1, σ 0.5
    ends = [interval(rows, 500, seed=trial) for trial, rows in enumerate(draws)]
    covered = float(np.mean([(low <= 1) & (high >= 1) for low, high in ends]))
    assert covered >= 0.93 - 3 * np.sqrt(0.93 * 0.07 / 600)


def test_the_interval_is_of_the_seed_and_the_same_in_any_batches(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rows = np.random.default_rng(1).random((7, 2))
    once = interval(rows, 100, seed=3)
    assert np.array_equal(once, interval(rows, 100, seed=3))
    assert not np.array_equal(once, interval(rows, 100, seed=4))
    monkeypatch.setattr("pnpdepth_cli.pipeline.evaluation.resampling._CELLS", 30)
    assert np.ravel(interval(rows, 100, seed=3)) == pytest.approx(np.ravel(once), rel=1e-12)


def test_equal_frames_have_an_interval_of_no_width() -> None:
    assert np.ravel(interval(np.full((6, 1), 2.5), 50)).tolist() == [2.5, 2.5]


def difference_of(changes: np.ndarray):  # type: ignore[no-untyped-def]
    return lambda flips: ((1 - 2 * flips) @ changes / len(changes))[:, None]


@given(st.lists(st.integers(-5, 5), min_size=2, max_size=7))
def test_the_exact_p_value_is_the_fraction_of_all_swaps_that_differ_as_much(
    changes: list[int],
) -> None:
    values = np.array(changes, float)
    swaps = [abs(np.dot(signs, values)) for signs in product((1, -1), repeat=len(values))]
    expected = np.mean([swap >= abs(values.sum()) - 1e-9 for swap in swaps])
    (p_value,), exact = sign_flip_p_values(difference_of(values), len(values), 1000, seed=0)
    assert exact
    assert p_value == expected


def test_the_exact_p_value_is_that_of_scipys_paired_permutations() -> None:
    first = np.random.default_rng(0).lognormal(0, 1, 10)
    second = first * np.random.default_rng(1).lognormal(0.2, 0.3, 10)
    (p_value,), _ = sign_flip_p_values(difference_of(second - first), 10, 2000, seed=0)
    expected = stats.permutation_test(
        (second, first),
        lambda a, b, axis: np.mean(a - b, axis=axis),
        permutation_type="samples",
        vectorized=True,
        n_resamples=np.inf,
    )
    assert p_value == pytest.approx(expected.pvalue, rel=1e-12)


def test_the_sampled_p_value_is_near_the_exact_one_and_never_zero() -> None:
    values = np.random.default_rng(0).normal(0.4, 1, 12)
    (exact_p,), exact = sign_flip_p_values(difference_of(values), 12, 4096, seed=0)
    (sampled_p,), sampled = sign_flip_p_values(difference_of(values), 12, 4095, seed=0)
    assert (exact, sampled) == (True, False)
    assert sampled_p == pytest.approx(exact_p, abs=0.03)
    (smallest,), _ = sign_flip_p_values(difference_of(np.ones(100)), 100, 999, seed=0)
    assert smallest == 1 / 1000


def test_a_measure_without_a_number_has_no_interval_and_no_p_value() -> None:
    rows = np.array([[1.0, np.nan], [2.0, 3.0], [4.0, 1.0], [3.0, 2.0], [7.0, 5.0]])
    low, high = interval(rows, 50)
    assert np.isnan([low[1], high[1]]).all()
    alone = np.ravel(interval(rows[:, :1], 50))
    assert [low[0], high[0]] == pytest.approx(alone, rel=1e-12)
    assert low[0] < rows[:, 0].mean() < high[0]
    p_values, _ = sign_flip_p_values(lambda flips: (1 - 2 * flips) @ rows, 5, 50, seed=0)
    assert p_values[0] == 2 / 32  # all differences have one sign
    assert np.isnan(p_values[1])


def test_measures_are_known_of_the_same_frames_or_apart() -> None:
    known = np.array([[1, 0, 1, 0], [1, 1, 1, 0], [1, 1, 1, 0]], bool)
    groups = [(frames.tolist(), columns) for frames, columns in known_together(known)]
    assert groups == [
        ([False, False, False], [3]),
        ([False, True, True], [1]),
        ([True, True, True], [0, 2]),
    ]
    assert clusters_among(np.array([2, 0, 2, 3]), np.array([1, 0, 1, 1], bool)).tolist() == [
        0,
        0,
        1,
    ]


def test_holm_multiplies_the_smallest_most_and_keeps_the_order() -> None:
    adjusted = holm(np.array([0.01, 0.04, np.nan, 0.03]))
    assert adjusted[[0, 1, 3]] == pytest.approx([0.03, 0.06, 0.06])
    assert np.isnan(adjusted[2])
    assert holm(np.array([0.9, 0.8])).tolist() == [1.0, 1.0]
