from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import example, given
from hypothesis import strategies as st

from pnpdepth_cli.completion.image_registration import (
    Evidence,
    ImageRegistration,
    estimated,
    evidence,
)
from pnpdepth_cli.points import SparsePoints
from tests.completion.unregistered import SIZE, UNREGISTERED, frame


def evidence_of(
    seed: int, registration: ImageRegistration | None = None, count: int = 500
) -> Evidence:
    known = evidence(*frame(seed, registration, count))
    assert known is not None
    return known


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(
    "registration",
    [
        UNREGISTERED,
        ImageRegistration(zoom=1.08, right=6.0, down=0.0),
        ImageRegistration(zoom=1.0, right=-9.0, down=5.0),
    ],
    ids=str,
)
def test_zoom_and_shift_between_the_cameras_are_found(
    seed: int, registration: ImageRegistration
) -> None:
    found = estimated([evidence_of(seed, registration)])
    assert found is not None
    assert found.zoom == pytest.approx(registration.zoom, abs=0.006)
    assert found.right == pytest.approx(registration.right, abs=0.2)
    assert found.down == pytest.approx(registration.down, abs=0.5)


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("count", [20, 100, 500, 4000])
def test_a_registered_image_stays(seed: int, count: int) -> None:
    assert estimated([evidence_of(seed, count=count)]) is None


def test_frames_with_few_points_show_together_what_each_does_not() -> None:
    frames = [evidence_of(seed, UNREGISTERED, count=80) for seed in range(8)]
    assert [estimated([each]) for each in frames] == [None] * 8
    found = estimated(frames)
    assert found is not None
    assert found.zoom == pytest.approx(UNREGISTERED.zoom, abs=0.02)


def test_the_registration_is_the_posteriors_mean_if_the_evidence_for_it_is_strong() -> None:
    zooms, down, right = np.linspace(0.85, 1.15, 31), np.arange(-24, 25, 2), np.arange(-32, 33, 2)
    spreads = (np.log(zooms) / 0.07, down / 480 / 0.025, right / 640 / 0.025)
    prior = np.exp(-0.5 * sum(axis**2 for axis in np.meshgrid(*spreads, indexing="ij")))
    one, other = (3, 20, 5), (9, 3, 30)

    def found(peaks: dict[tuple[int, int, int], float]) -> ImageRegistration | None:
        log_likelihood = np.zeros(prior.shape)
        for cell, height in peaks.items():
            log_likelihood[cell] = height
        return estimated([Evidence(log_likelihood=log_likelihood, size=(480, 640))])

    weight = prior[one] / (prior[one] + np.exp(0.5) * prior[other])
    assert 0.1 < weight < 0.9
    means = [weight * axis[one[i]] + (1 - weight) * axis[other[i]]
             for i, axis in enumerate((zooms, down, right))]  # fmt: skip
    assert found({one: 60.0, other: 60.5}) == ImageRegistration(
        zoom=round(means[0], 4), down=round(means[1], 2), right=round(means[2], 2)
    )
    for bayes_factor in (3.9, 4.1):  # of its logarithm, over that of a registered image
        height = np.log1p((np.exp(bayes_factor) - 1) * prior.sum() / prior[one])
        assert (found({one: height}) is None) == (bayes_factor < 4)


def test_frames_of_another_size_than_the_first_are_left_out() -> None:
    first, other = evidence_of(0, UNREGISTERED), evidence_of(1)
    smaller = Evidence(log_likelihood=other.log_likelihood[:, 1:-1], size=(200, 320))
    assert estimated([first, smaller]) == estimated([first])


def test_points_that_were_found_in_the_image_show_nothing() -> None:
    rgb, _ = frame(0)
    contrast = np.abs(np.diff(rgb.mean(-1), axis=1))[:, :-1] > 0.1
    rows, columns = np.nonzero(contrast)
    rng = np.random.default_rng(0)
    chosen = rng.choice(len(rows), 300, replace=False)
    points = SparsePoints(
        xy=torch.from_numpy(np.stack([columns, rows], axis=1)[chosen].astype(np.float32)),
        depth=torch.from_numpy(rng.uniform(1, 5, 300).astype(np.float32)),
        size=SIZE,
    )
    assert evidence(rgb, points) is None


def test_scan_lines_few_points_and_points_of_one_side_show_nothing() -> None:
    rgb, points = frame(0, UNREGISTERED, count=4000)
    assert evidence(rgb, points.select(points.xy[:, 1] % 8 == 0)) is None
    assert evidence(rgb, points.select(torch.arange(4000) < 9)) is None
    assert evidence(rgb, points.select(points.xy[:, 0] < 100)) is None


@pytest.mark.parametrize("case", ["on a line", "at one depth", "an image without an edge"])
def test_points_or_an_image_without_an_edge_leave_the_image(case: str) -> None:
    rgb, points = frame(0, UNREGISTERED)
    xy, depth = points.xy.clone(), torch.full((500,), 2.0)
    if case == "on a line":
        xy[:, 1] = 100.0
    if case == "an image without an edge":
        rgb, depth = np.full((*SIZE, 3), 0.5, np.float32), points.depth
    known = evidence(rgb, SparsePoints(xy=xy, depth=depth, size=SIZE))
    assert estimated([known] if known is not None else []) is None


@example(right=0, down=0)
@given(right=st.integers(-6, 6), down=st.integers(-6, 6))
def test_an_image_moved_by_whole_pixels_keeps_its_values(right: int, down: int) -> None:
    rgb = np.random.default_rng(0).random((20, 30, 3), np.float32)
    moved = ImageRegistration(zoom=1.0, right=float(right), down=float(down)).applied(rgb)
    assert (moved == rgb).all() == (right == down == 0)
    expected = np.roll(rgb, (-down, -right), axis=(0, 1))
    assert (moved[6:-6, 6:-6] == expected[6:-6, 6:-6]).all()


def test_the_colour_of_a_pixel_is_where_the_registration_says() -> None:
    y, x = np.mgrid[:41, :61].astype(np.float32)
    ramp = np.stack([x, y, x + y], axis=-1)
    moved = ImageRegistration(zoom=0.5, right=4.0, down=-2.0).applied(ramp)
    assert moved[30, 40, 0] == pytest.approx(30 + 0.5 * (40 - 30) + 4)
    assert moved[30, 40, 1] == pytest.approx(20 + 0.5 * (30 - 20) - 2)
