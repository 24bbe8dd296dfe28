from __future__ import annotations

import numpy as np
import pytest
import torch

from pnpdepth_cli.completion.image_registration import (
    Evidence,
    ImageRegistration,
    estimate_registration,
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
    found = estimate_registration([evidence_of(seed, registration)])
    assert isinstance(found, ImageRegistration)
    assert found.zoom == pytest.approx(registration.zoom, abs=0.012)
    assert found.right == pytest.approx(registration.right, abs=1.5)
    assert found.down == pytest.approx(registration.down, abs=1.5)


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("count", [20, 100, 500, 4000])
def test_a_registered_image_stays(seed: int, count: int) -> None:
    assert estimate_registration([evidence_of(seed, count=count)]) is None


@pytest.mark.parametrize("gap_px", [5, 8])
def test_a_registered_image_stays_where_points_beside_jumps_are_missing(gap_px: int) -> None:
    known = [evidence(*frame(seed, count=500, gap_px=gap_px)) for seed in range(8)]
    assert None not in known
    assert estimate_registration(known) is None


def test_frames_with_few_points_show_together_what_each_does_not() -> None:
    frames = [evidence_of(seed, UNREGISTERED, count=80) for seed in range(8)]
    assert [estimate_registration([alone]) for alone in frames[:3]] == [None] * 3
    found = estimate_registration(frames)
    assert isinstance(found, ImageRegistration)
    assert found.zoom == pytest.approx(UNREGISTERED.zoom, abs=0.02)


@pytest.mark.parametrize("zoom", [0.72, 1.4])
def test_frames_show_together_that_the_image_sees_much_less_or_more(zoom: float) -> None:
    there = ImageRegistration(zoom=zoom, right=6.0, down=-4.0)
    found = estimate_registration([evidence_of(seed, there) for seed in range(4)])
    assert isinstance(found, ImageRegistration)
    assert found.zoom == pytest.approx(zoom, abs=0.01)
    assert (found.right, found.down) == pytest.approx((6.0, -4.0), abs=0.5)


@pytest.mark.parametrize(("count", "frames"), [(100, 6), (500, 5)])
def test_images_of_other_scenes_are_not_moved(count: int, frames: int) -> None:
    pairs = [
        (frame(seed + 20, count=count)[0], frame(seed, count=count)[1]) for seed in range(frames)
    ]
    assert estimate_registration([evidence(*pair) for pair in pairs]) is None


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
    assert estimate_registration([known] if known is not None else []) is None


def test_the_colour_of_a_pixel_is_where_the_registration_says() -> None:
    y, x = np.mgrid[:41, :61].astype(np.float32)
    ramp = np.stack([x, y, x + y], axis=-1)
    moved = ImageRegistration(zoom=0.5, right=4.0, down=-2.0).apply_to(ramp)
    assert moved[30, 40, 0] == pytest.approx(30 + 0.5 * (40 - 30) + 4)
    assert moved[30, 40, 1] == pytest.approx(20 + 0.5 * (30 - 20) - 2)
