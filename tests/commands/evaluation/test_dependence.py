"""Which frames count as independent: groups by name, and blocks of a correlated sequence."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from pnpdepth_cli.commands.evaluation.dependence import (
    block_length,
    find_clusters,
    groups_by_name,
)

NAMES = [
    ("2011_09_26_drive_0002_sync_0000000008_image_02", "2011_09_26_drive_0002_sync"),
    ("seq-01_000012", "seq-01"),
    ("office/0012", "office"),
    ("office/frame_0012", "office/frame"),
    ("00_000004", "00"),
    ("0012", ""),
    ("1305031102.175304", ""),
    ("left", ""),
    ("run/left", "run"),
]


@pytest.mark.parametrize(("name", "group"), NAMES)
def test_the_group_of_a_frame_is_its_name_before_the_frame_number(name: str, group: str) -> None:
    assert groups_by_name([name, name]) == [group, group]


def test_names_of_which_some_have_no_number_are_grouped_by_folder() -> None:
    assert groups_by_name(["a", "b_1", "office/c_2"]) == ["", "", "office"]


def autoregression(correlation: float, frames: int, seed: int) -> np.ndarray:
    noise = np.random.default_rng(seed).normal(size=(frames + 200, 1))
    return np.asarray(lfilter([1.0], [1.0, -correlation], noise, axis=0)[200:])


def test_groups_are_clusters_in_the_order_of_the_frames() -> None:
    clusters = find_clusters(["b", "a", "b", "c"], np.zeros((4, 1)))
    assert clusters.ids.tolist() == [0, 1, 0, 2]
    assert clusters.describe() == "3 groups of frames"
    assert find_clusters(["b", "a"], np.zeros((2, 1))).describe() == "2 frames"


def test_one_sequence_of_independent_frames_has_a_cluster_for_each() -> None:
    lengths = [block_length(autoregression(0.0, 100, seed)) for seed in range(40)]
    assert np.mean([length == 1 for length in lengths]) >= 0.7  # 84 % in the long run
    assert find_clusters([""] * 6, np.arange(6.0)[:, None] % 2).describe() == "6 frames"


def test_one_correlated_sequence_is_cut_into_a_few_long_blocks() -> None:
    series = autoregression(0.5, 1000, 0)
    # 2ρ/(1 − ρ²)/L of the variance is missing: 1.33/L, a tenth at 13.3
    assert block_length(series) == pytest.approx(14, abs=3)
    clusters = find_clusters(["drive"] * 1000, series)
    assert (np.diff(clusters.ids) >= 0).all()
    assert np.bincount(clusters.ids).tolist() == [100] * 10
    assert "blocks of about 100 consecutive frames" in clusters.describe()
    short = find_clusters(["drive"] * 60, autoregression(0.5, 60, 0))
    assert short.count == 60 // block_length(autoregression(0.5, 60, 0)) < 6


def test_long_blocks_hold_also_for_a_slow_drift_under_noise() -> None:
    rng = np.random.default_rng(0)

    def drift(frames: int) -> np.ndarray:
        steps = lfilter([1.0], [1.0, -0.9], rng.normal(size=(frames + 200, 1)), axis=0)[200:]
        return np.asarray(steps + 1.5 * rng.normal(size=(frames, 1)))

    block_means = []
    for _ in range(200):
        series = drift(400)
        clusters = find_clusters([""] * 400, series)
        block_means.append(np.bincount(clusters.ids, series[:, 0]) / np.bincount(clusters.ids))
    neighbours = np.concatenate([np.column_stack([m[:-1], m[1:]]) for m in block_means])
    assert np.corrcoef(neighbours.T)[0, 1] < 0.25  # frames: 0.6


def test_columns_without_a_number_do_not_decide_the_blocks() -> None:
    series = autoregression(0.8, 200, 1)
    with_nan = np.column_stack([series, np.full(200, np.nan)])
    assert block_length(with_nan) == block_length(series) > 1
    assert block_length(np.full((200, 1), np.nan)) == 1
    assert block_length(np.ones((200, 1))) == 1
