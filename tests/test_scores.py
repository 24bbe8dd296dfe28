from __future__ import annotations

import pickle
from math import isnan

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from pnpdepth_cli.measures import MEASURES, Measure, score, with_thresholds
from tests.plain_scores import brute

depths = st.one_of(
    st.floats(0.125, 100, width=32), st.sampled_from([0.0, -1.0, np.nan, np.inf, -np.inf])
)


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
    assert isnan(scores["rmse"])
    assert isnan(scores.coverage)
    assert score(torch.zeros(2), torch.ones(2)).coverage == 0


def test_scores_have_every_measure_in_its_order_then_pixels_and_coverage() -> None:
    scores = score(torch.ones(2), torch.ones(2))
    assert [*scores.to_json()] == [*(measure.key for measure in MEASURES), "pixels", "coverage"]


def test_a_measure_is_read_by_its_key_and_another_name_is_no_attribute() -> None:
    scores = score(torch.ones(2), torch.ones(2))
    assert scores["delta3"] == 1
    with pytest.raises(AttributeError):
        _ = scores.delta4


def test_scores_survive_a_pickle() -> None:
    scores = score(torch.ones(2), torch.ones(2))
    assert pickle.loads(pickle.dumps(scores)) == scores


@pytest.mark.parametrize("measure", MEASURES, ids=lambda measure: measure.key)
def test_a_measure_grows_with_the_depths_as_its_unit_does(measure: Measure) -> None:
    rng = np.random.default_rng(0)
    truth = torch.from_numpy(rng.uniform(1, 9, 100))
    predicted = truth * torch.from_numpy(rng.uniform(0.5, 2, 100))
    of_depths = score(predicted, truth)[measure.key]
    of_doubled = score(2 * predicted, 2 * truth)[measure.key]
    factor = {"m": 2.0, "1/km": 0.5}.get(measure.unit, 1.0)
    assert of_doubled == pytest.approx(factor * of_depths, rel=1e-6)
    assert of_depths != 0


def test_of_all_measures_only_the_deltas_are_better_when_they_are_higher() -> None:
    higher = [measure.key for measure in MEASURES if measure.better == "higher"]
    assert higher == ["delta1", "delta2", "delta3"]


def test_the_thresholds_of_delta_can_be_the_papers_kitti_ones() -> None:
    predicted = torch.tensor([1.009, 1.015, 1.025, 1.04])
    gt = torch.ones(4)
    scores = score(predicted, gt, with_thresholds([1.01, 1.01**2, 1.01**3]))
    assert (scores["delta1"], scores["delta2"], scores["delta3"]) == (0.25, 0.5, 0.75)
