"""Intervals and p-values against textbooks, scipy.stats and brute force; Holm by hand."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from pnpdepth_cli.commands.evaluation.resampling import (
    FrameTable,
    gain,
    gain_interval,
    holm,
    mean_interval,
    sign_flip_p_values,
    swap_p_values,
)
from pnpdepth_cli.core.metrics import SUMS, error_sums, score


def interval(
    rows: np.ndarray, resamples: int, seed: int = 0, clusters: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    ids = np.arange(len(rows)) if clusters is None else clusters
    return mean_interval(FrameTable.of_frames(rows), ids, resamples, seed)


def test_the_mean_of_frames_counts_each_alike_among_those_that_have_the_measure() -> None:
    table = FrameTable.of_frames(np.array([[1.0, 10.0, np.nan], [3.0, np.nan, np.nan]]))
    assert table.mean() == pytest.approx([2, 10, np.nan], nan_ok=True)
    totals = FrameTable.of_frames(np.array([[1.0], [3.0], [6.0]])).cluster_totals(
        np.array([1, 0, 1])
    )
    assert totals.tolist() == [[[3, 1]], [[7, 2]]]


def test_the_pooled_mean_counts_each_pixel_alike() -> None:
    generator = torch.Generator().manual_seed(0)
    frames = [torch.rand(2, n, generator=generator) + 1 for n in (3, 50)]
    sums = np.array([error_sums(p, g)[0].tolist() for p, g in frames])
    together = torch.cat(frames, dim=1)
    expected = score(together[0], together[1])
    mean = FrameTable.of_pixels(sums, ["rmse", "delta1"]).mean()
    assert mean == pytest.approx([expected.rmse, expected.delta1], rel=1e-12)


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
    low, high = mean_interval(FrameTable.of_pixels(sums, ["rmse"]), np.arange(300), 4000, 0)
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
    monkeypatch.setattr("pnpdepth_cli.commands.evaluation.resampling._CELLS", 30)
    assert np.ravel(interval(rows, 100, seed=3)) == pytest.approx(np.ravel(once), rel=1e-12)


def test_equal_frames_have_an_interval_of_no_width() -> None:
    assert np.ravel(interval(np.full((6, 1), 2.5), 50)) == pytest.approx([2.5, 2.5], abs=1e-12)


def test_the_gain_is_in_per_cent_of_the_first_and_its_interval_narrows_with_equal_gains() -> None:
    before = np.random.default_rng(0).lognormal(0, 1, (9, 2))
    first, half = (FrameTable.of_frames(rows) for rows in (before, before / 2))
    better = np.array([-1.0, 1.0])
    assert gain(first.mean(), half.mean(), better).tolist() == [50, -50]
    bounds = gain_interval(first, half, better, np.arange(9), 100, 0)
    assert np.stack(bounds) == pytest.approx(np.array([[50, -50], [50, -50]]), abs=1e-6)
    noisy = FrameTable.of_frames(before * np.random.default_rng(1).uniform(0.3, 0.7, before.shape))
    low, high = gain_interval(first, noisy, better, np.arange(9), 500, 0)
    value = gain(first.mean(), noisy.mean(), better)
    assert (low < value - 1).all()
    assert (value + 1 < high).all()
    assert np.isnan(gain(np.zeros(2), np.array([1.0, np.nan]), better)).all()


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


def test_the_sampled_p_value_is_near_the_exact_one_and_never_zero() -> None:
    values = np.random.default_rng(0).normal(0.4, 1, 12)
    (exact_p,), exact = sign_flip_p_values(difference_of(values), 12, 4096, seed=0)
    (sampled_p,), sampled = sign_flip_p_values(difference_of(values), 12, 4095, seed=0)
    assert (exact, sampled) == (True, False)
    assert sampled_p == pytest.approx(exact_p, abs=0.03)
    (smallest,), _ = sign_flip_p_values(difference_of(np.ones(100)), 100, 999, seed=0)
    assert smallest == 1 / 1000


def test_a_measure_that_some_frames_lack_has_the_interval_of_the_others() -> None:
    rows = np.random.default_rng(0).lognormal(0, 0.5, (12, 3))
    rows[:4, 1] = np.nan
    rows[:8, 2] = np.nan  # four frames are too few
    low, high = interval(rows, 4000)
    for column, frames in ((0, rows[:, :1]), (1, rows[4:, 1:2])):
        alone_low, alone_high = np.ravel(interval(frames, 4000))
        width = alone_high - alone_low
        assert [low[column], high[column]] == pytest.approx(
            [alone_low, alone_high], abs=(0.2 if column else 1e-9) * width
        )
        assert low[column] < frames.mean() - width / 10
        assert high[column] > frames.mean() + width / 10
    assert np.isnan([low[2], high[2]]).all()
    other = FrameTable.of_frames(rows * 1.5)
    p_values, exact = swap_p_values(FrameTable.of_frames(rows), other, np.arange(12), 4096, 0)
    assert exact
    assert p_values == pytest.approx([2 / 2**12, 2 / 2**8, 2 / 2**4])  # all got worse
    nothing, _ = sign_flip_p_values(lambda flips: np.full((len(flips), 1), np.nan), 5, 50, seed=0)
    assert np.isnan(nothing).all()


def test_holm_multiplies_the_smallest_most_and_keeps_the_order() -> None:
    adjusted = holm(np.array([0.01, 0.04, np.nan, 0.03]))
    assert adjusted[[0, 1, 3]] == pytest.approx([0.03, 0.06, 0.06])
    assert np.isnan(adjusted[2])
    assert holm(np.array([0.9, 0.8])).tolist() == [1.0, 1.0]
