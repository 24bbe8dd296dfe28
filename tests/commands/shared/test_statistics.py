"""Clusters, intervals and p-values against textbooks, scipy.stats and brute force; Holm by hand."""

from __future__ import annotations

from functools import partial
from itertools import product

import numpy as np
import pytest
from scipy import stats
from scipy.signal import lfilter

from pnpdepth_cli.commands.shared import statistics
from pnpdepth_cli.commands.shared.statistics import Clusters, block_length, find_clusters
from pnpdepth_cli.dataset.frame_files import groups_of


def clusters_of(ids: object) -> Clusters:
    return Clusters(ids=np.asarray(ids), text="frames")


def interval(values: np.ndarray, ids: object = None) -> list[float]:
    """The ends of the interval of the mean."""
    clusters = clusters_of(np.arange(len(values)) if ids is None else ids)
    return [*statistics.interval(lambda mean: mean, [values], clusters)]


def test_each_end_is_the_farther_one_of_students_t_and_of_t_corrected_for_skewness() -> None:
    values = np.random.default_rng(2).lognormal(0, 0.5, 9)
    student = stats.t.interval(0.95, 8, loc=values.mean(), scale=stats.sem(values))
    skew = stats.skew(values, bias=False) / 3
    # Hall's transformation of t, which is a cubic, at the end of the interval
    low, high = interval(values)
    assert low == pytest.approx(student[0])  # the errors are skewed
    t = (values.mean() - high) / stats.sem(values)
    cubic = t + skew * t**2 / 3 + skew**2 * t**3 / 27 + skew / 6
    assert cubic == pytest.approx(stats.t.ppf(0.025, 8))
    assert high > student[1]
    # clusters of equal frames are as sure as one frame each
    of_clusters = interval(np.repeat(values, 20), ids=np.repeat(np.arange(9), 20))
    assert of_clusters == pytest.approx([low, high])
    assert interval(np.full(6, 2.5)) == [2.5, 2.5]


@pytest.mark.parametrize("frames", [5, 8, 20])
@pytest.mark.parametrize("spread", [0.05, 0.5])
def test_intervals_hold_the_true_mean_in_93_to_97_per_cent(frames: int, spread: float) -> None:
    rng = np.random.default_rng(0)
    trials = 1500
    draws = rng.lognormal(-(spread**2) / 2, spread, (frames, trials))  # of mean 1
    low, high = np.array([interval(draw) for draw in draws.T]).T
    error = np.sqrt(0.95 * 0.05 / trials)
    assert 0.93 - 2 * error < float(np.mean((low <= 1) & (high >= 1))) < 0.97 + 2 * error


@pytest.mark.parametrize("sign", [-1, 1])
def test_the_gain_is_in_per_cent_of_the_first_and_narrow_for_equal_gains(sign: int) -> None:
    before = np.random.default_rng(0).lognormal(0, 1, 9)
    noise = np.random.default_rng(1).uniform(0.3, 0.7, 9)
    change = partial(statistics.gain, sign=sign)
    clusters = clusters_of(np.arange(9))
    half = statistics.interval(change, [before, before / 2], clusters)
    assert half == pytest.approx((-50 * sign, -50 * sign), abs=1e-6)
    low, high = statistics.interval(change, [before, before * noise], clusters)
    assert low + 1 < float(change(before.mean(), (before * noise).mean())) < high - 1
    assert np.isnan(statistics.gain(np.zeros(2), np.array([1.0, np.nan]), sign)).all()
    assert np.isnan(statistics.gain(1.0, 2.0, 0))  # neither is better


def p_value_of(changes: np.ndarray) -> float:
    """Of runs whose frames differ by these."""
    return statistics.swap_p_value(0 * changes, changes, clusters_of(np.arange(len(changes))))


def test_the_p_value_is_the_fraction_of_all_swaps_that_differ_as_much_and_never_zero() -> None:
    rng = np.random.default_rng(0)
    exact = [row for count in range(2, 8) for row in rng.integers(-5, 6, (10, count))]
    for changes in [*exact, rng.normal(0.4, 1, 14)]:  # 2^14 swaps are more than are tried
        tolerance = 0.01 if len(changes) == 14 else 1e-12
        swaps = np.array([*product((1, -1), repeat=len(changes))]) @ changes
        fraction = np.mean(abs(swaps) >= abs(changes.sum()) - 1e-9)
        assert p_value_of(changes.astype(float)) == pytest.approx(fraction, abs=tolerance)
    assert p_value_of(np.ones(100)) == 2 / 10_001


def test_a_measure_that_some_frames_lack_has_the_interval_of_the_others() -> None:
    values = np.random.default_rng(0).lognormal(0, 0.5, 12)
    values[:4] = np.nan
    assert interval(values) == pytest.approx(interval(values[4:]))
    assert statistics.swap_p_value(values, 1.5 * values, clusters_of(np.arange(12))) == 2 / 2**8
    values[:8] = np.nan  # four frames are too few
    assert np.isnan(interval(values)).all()
    assert np.isnan(p_value_of(np.full(5, np.nan)))


def test_holm_multiplies_the_smallest_most_and_keeps_the_order() -> None:
    adjusted = statistics.holm(np.array([0.01, 0.04, np.nan, 0.03]))
    assert adjusted == pytest.approx([0.03, 0.06, np.nan, 0.06], nan_ok=True)
    assert statistics.holm(np.array([[0.9], [0.8]])).tolist() == [[1.0], [1.0]]


NAMES = [
    (["2011_09_26_drive_0002_sync_0000000008_image_02"], ["2011_09_26_drive_0002_sync"]),
    (["seq-01_000012", "office/0012", "office/frame_0012"], ["seq-01", "office", "office/frame"]),
    (["a", "b_1", "office/c_2"], ["", "", "office"]),  # one has no number
]


def test_the_group_of_a_frame_is_its_name_before_the_frame_number() -> None:
    for names, groups in NAMES:
        assert groups_of(names, [None] * len(names)) == groups


def autoregression(correlation: float, frames: int, seed: int = 0) -> np.ndarray:
    noise = np.random.default_rng(seed).normal(size=(frames + 200, 1))
    return np.asarray(lfilter([1.0], [1.0, -correlation], noise, axis=0)[200:])


def test_groups_are_clusters_and_so_is_each_frame_of_one_uncorrelated_sequence() -> None:
    clusters = find_clusters(["b", "a", "b", "c"], np.zeros((4, 1)))
    assert (clusters.ids.tolist(), clusters.text) == ([0, 1, 0, 2], "3 groups of frames")
    assert find_clusters(["b", "a"], np.zeros((2, 1))).text == "2 frames"
    assert find_clusters([""] * 6, np.arange(6.0)[:, None] % 2).text == "6 frames"
    lengths = [block_length(autoregression(0.0, 100, seed)) for seed in range(40)]
    assert np.mean([length == 1 for length in lengths]) >= 0.7  # 84 % in the long run


def test_one_correlated_sequence_is_cut_into_a_few_long_blocks() -> None:
    series = autoregression(0.5, 1000)
    # 2ρ/(1 − ρ²)/L of the variance is missing: 1.33/L, a tenth at 13.3
    assert block_length(series) == pytest.approx(14, abs=3)
    clusters = find_clusters(["drive"] * 1000, series)
    assert clusters.ids.tolist() == [number // 100 for number in range(1000)]
    assert "100 consecutive frames" in clusters.text


def test_the_correlation_of_a_short_sequence_is_corrected_and_its_blocks_are_too_few() -> None:
    short = autoregression(0.5, 60)
    correlation = np.corrcoef(short[1:, 0], short[:-1, 0])[0, 1]
    correlation += (1 + 3 * correlation) / 60  # Kendall's correction
    expected = 2 * correlation / (1 - correlation**2) / statistics.BLOCK_BIAS
    assert block_length(short) == pytest.approx(expected, abs=1.5)
    assert find_clusters(["drive"] * 60, short).count == 60 // block_length(short) < 6


def test_a_measure_without_values_or_changes_does_not_lengthen_the_blocks() -> None:
    series = autoregression(0.5, 1000)
    with_unknown = np.column_stack([series, np.full(1000, np.nan)])
    assert block_length(with_unknown) == block_length(series)
    assert block_length(np.full((200, 1), np.nan)) == block_length(np.ones((200, 1))) == 1
    rounded = 0.1 + 1e-16 * np.arange(200)[:, None]  # differences that are equal
    assert block_length(rounded) == 1
