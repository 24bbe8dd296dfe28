"""Means over frames, their bootstrap intervals, and permutation p-values."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from pnpdepth_cli.core.metrics import error_sums, score
from pnpdepth_cli.pipeline.evaluation.averages import FrameTable, bootstrap, sign_flip_p_values


def test_the_mean_of_frames_counts_each_alike() -> None:
    table = FrameTable(rows=np.array([[1.0, 10.0], [3.0, 30.0]]))
    assert table.mean().tolist() == [2, 20]
    assert table.means(np.array([[2.0, 0.0], [0.0, 2.0]])).tolist() == [[1, 10], [3, 30]]


def test_the_pooled_mean_counts_each_pixel_alike() -> None:
    generator = torch.Generator().manual_seed(0)
    frames = [torch.rand(2, n, generator=generator) + 1 for n in (3, 50)]
    rows = np.array([error_sums(p, g)[0].tolist() for p, g in frames])
    together = torch.cat(frames, dim=1)
    expected = score(together[0], together[1])
    mean = FrameTable(rows=rows, pooled=True).mean()
    assert mean[0] == pytest.approx(expected.rmse, rel=1e-12)
    assert mean[9] == pytest.approx(expected.delta1, rel=1e-12)


def test_the_interval_is_the_textbooks_for_many_frames() -> None:
    rows = np.random.default_rng(1).normal(5, 2, size=(400, 1))
    low, high = bootstrap(FrameTable(rows=rows).means, 400, 4000, seed=0)
    standard_error = rows.std() / np.sqrt(400)
    assert low[0] == pytest.approx(rows.mean() - 1.96 * standard_error, abs=0.1 * standard_error)
    assert high[0] == pytest.approx(rows.mean() + 1.96 * standard_error, abs=0.1 * standard_error)


def test_the_interval_is_of_the_seed_and_the_same_in_any_batches(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    means = FrameTable(rows=np.random.default_rng(1).random((7, 2))).means
    once = bootstrap(means, 7, 100, seed=3)
    assert np.array_equal(once, bootstrap(means, 7, 100, seed=3))
    assert not np.array_equal(once, bootstrap(means, 7, 100, seed=4))
    monkeypatch.setattr("pnpdepth_cli.pipeline.evaluation.averages._CELLS", 30)
    assert np.array_equal(once, bootstrap(means, 7, 100, seed=3))


def difference_of(changes: np.ndarray):  # type: ignore[no-untyped-def]
    return lambda flips: ((1 - 2 * flips) @ changes / len(changes))[:, None]


@given(st.lists(st.integers(-5, 5), min_size=2, max_size=7))
def test_the_exact_p_value_is_the_share_of_all_swaps_that_differ_as_much(
    changes: list[int],
) -> None:
    values = np.array(changes, float)
    swaps = [abs(np.dot(signs, values)) for signs in product((1, -1), repeat=len(values))]
    expected = np.mean([swap >= abs(values.sum()) - 1e-9 for swap in swaps])
    (found,), exact = sign_flip_p_values(difference_of(values), len(values), 1000, seed=0)
    assert exact
    assert found == expected


def test_the_sampled_p_value_is_near_the_exact_one_and_never_zero() -> None:
    values = np.random.default_rng(0).normal(0.4, 1, 12)
    (exact_p,), exact = sign_flip_p_values(difference_of(values), 12, 4096, seed=0)
    (sampled_p,), sampled = sign_flip_p_values(difference_of(values), 12, 4095, seed=0)
    assert (exact, sampled) == (True, False)
    assert sampled_p == pytest.approx(exact_p, abs=0.03)
    (smallest,), _ = sign_flip_p_values(difference_of(np.ones(100)), 100, 999, seed=0)
    assert smallest == 1 / 1000


def test_a_measure_without_a_number_has_no_interval_and_no_p_value() -> None:
    rows = np.array([[1.0, np.nan], [2.0, 3.0]])
    low, high = bootstrap(FrameTable(rows=rows).means, 2, 50, seed=0)
    assert np.isfinite(low[0])
    assert np.isnan([low[1], high[1]]).all()
    found, _ = sign_flip_p_values(lambda flips: flips @ rows + rows[0], 2, 50, seed=0)
    assert np.isnan(found[1])
