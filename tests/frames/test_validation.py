"""Validation points, and by how much one prediction of them is better than another."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from pnpdepth_cli.completion.interpolation import nearest_points
from pnpdepth_cli.frames.validation import FOLDS, split_frame, whole_frame
from pnpdepth_cli.points import SparsePoints
from tests.frames.scenes import depth_of_scene, frame_in_memory, split_of


def test_a_gain_is_in_standard_errors_of_the_weighted_mean() -> None:
    rng = np.random.default_rng(0)
    (truth, at, other) = rng.uniform(1, 4, (3, 50))
    shares = rng.uniform(size=50)
    split = replace(split_of(torch.from_numpy(truth)), weights=torch.from_numpy(shares))
    gains = np.abs(np.log(other / truth)) - np.abs(np.log(at / truth))
    mean = np.average(gains, weights=shares)
    error = np.sqrt((shares**2 * (gains - mean) ** 2).sum()) / shares.sum()
    found = split.gain(torch.from_numpy(at), torch.from_numpy(other))
    assert found == pytest.approx(mean / error)


def test_points_in_one_hole_are_one_observation_of_a_gain() -> None:
    rng = np.random.default_rng(0)
    (truth, at, other) = rng.uniform(1, 4, (3, 30))
    shares = rng.uniform(size=30)
    hole = np.repeat([7, 3, 5], 10)
    split = replace(
        split_of(torch.from_numpy(truth)),
        weights=torch.from_numpy(shares),
        hole=torch.from_numpy(hole),
    )
    gains = np.abs(np.log(other / truth)) - np.abs(np.log(at / truth))
    of_holes = [np.average(gains[hole == k], weights=shares[hole == k]) for k in (3, 5, 7)]
    found = split.gain(torch.from_numpy(at), torch.from_numpy(other))
    assert found == pytest.approx(np.mean(of_holes) / (np.std(of_holes) / np.sqrt(3)))


@pytest.mark.parametrize("count", [60, 5500])
def test_validation_points_are_a_fifth_and_the_others_are_kept(count: int) -> None:
    frame = frame_in_memory(count)
    prediction = depth_of_scene()
    prediction[:, 100:] = 0
    split = split_frame(whole_frame(frame, None), prediction, [], seed=0)
    kept, held, whole = (
        {tuple(xy) for xy in points.xy.tolist()}
        for points in (split.kept.points, split.points, frame.points)
    )
    assert len(kept) == count - count // FOLDS
    assert len(held) == min(count // FOLDS, 1000)
    assert kept | held <= whole
    assert not kept & held
    assert torch.equal(split.weights != 0, split.points.xy[:, 0] < 100)  # where a depth is known


def test_validation_points_of_a_depth_map_are_under_copies_of_its_holes() -> None:
    prediction = depth_of_scene()
    known = torch.rand(prediction.shape, generator=torch.Generator().manual_seed(0)) > 1e-3
    holes = torch.nn.functional.max_pool2d((~known)[None].float(), 9, 1, 4)[0] > 0
    row, column = (~holes).nonzero(as_tuple=True)
    points = SparsePoints(
        xy=torch.stack([column, row], dim=1).float(),
        depth=prediction[row, column],
        size=(prediction.shape[0], prediction.shape[1]),
    )
    frame = replace(frame_in_memory(), points=points)
    split = split_frame(whole_frame(frame, None), prediction, [], seed=0)
    apart, _ = nearest_points(split.kept.points, split.points.xy.double(), 1)
    assert not split.has_scan_lines
    assert float(apart.max()) >= 3
    assert 0 < len(points) - len(split.kept.points) <= len(points) // FOLDS
