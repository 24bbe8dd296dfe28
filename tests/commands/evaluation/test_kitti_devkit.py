"""The development kit's figures: filled in by plain loops, and as its own program printed them."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from pnpdepth_cli.commands.evaluation import kitti_devkit
from pnpdepth_cli.io.depth import read_depth
from pnpdepth_cli.measures import DEVKIT_MEASURES

SAMPLES = Path(__file__).parents[3] / "samples"
F = np.float32


def filled_by_loops(depth: np.ndarray) -> np.ndarray:
    """What the readme of the kit says of missing predictions, one row or column after the other."""
    out = np.where(depth > 0, depth, F(-1))
    for row in out:
        for a, b in pairwise(np.flatnonzero(row >= 0)):
            row[a + 1 : b] = min(row[a], row[b])
    for line in (*out, *out.T):
        known = np.flatnonzero(line >= 0)
        if len(known):
            line[: known[0]] = line[known[0]]
            line[known[-1] + 1 :] = line[known[-1]]
    return out


CODES = st.one_of(st.just(0), st.integers(0, 3), st.integers(1, 20_000))
"""KITTI's depth codes, many of them unknown."""


@given(arrays(np.uint16, (4, 5), elements=CODES))
def test_what_is_missing_is_filled_as_by_the_loops_of_the_definition(stored: np.ndarray) -> None:
    depth = stored.astype(F) / F(256)
    np.testing.assert_array_equal(kitti_devkit.fill_background(depth), filled_by_loops(depth))


def test_the_figures_are_those_of_the_official_program() -> None:
    """Printed by evaluate_depth of the kit (g++ -O3) for the sample's scan and its ground truth."""
    predicted = read_depth(SAMPLES / "street" / "sparse.png").values
    gt = read_depth(SAMPLES / "street" / "gt.png").values
    printed = "5.375677 11.679524 0.025707 0.039534 0.325306 0.521867 0.501333 0.289888 0.218769"
    errors = kitti_devkit.devkit_errors(predicted, gt)
    assert [f"{errors[measure.key]:f}" for measure in DEVKIT_MEASURES] == printed.split()


def test_the_mean_over_frames_is_added_up_in_single_precision_too() -> None:
    values = np.random.default_rng(0).random((1000, 2))
    total = np.zeros(2, F)
    for row in values:
        total = total + row.astype(F)
    assert kitti_devkit.devkit_mean(values).tolist() == (total / F(1000)).astype(float).tolist()
