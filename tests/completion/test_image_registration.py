from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from pnpdepth_cli.completion.image_registration import (
    ImageRegistration,
    better_orientation,
    estimate_registration,
)
from pnpdepth_cli.completion.registration_evidence import evidence
from pnpdepth_cli.points import SparsePoints
from tests.completion.unregistered import SIZE, UNREGISTERED, frame


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(
    ("registration", "frames", "off_px"),
    [
        (UNREGISTERED, 1, 1.5),
        (ImageRegistration(zoom=1.08, right=6.0, down=0.0), 1, 1.5),
        (ImageRegistration(zoom=1.0, right=-9.0, down=5.0), 1, 1.5),
        # together they show that the image sees much less or more
        (ImageRegistration(zoom=0.72, right=6.0, down=-4.0), 4, 0.5),
        (ImageRegistration(zoom=1.4, right=6.0, down=-4.0), 4, 0.5),
    ],
    ids=str,
)
def test_zoom_and_shift_between_the_cameras_are_found(
    seed: int, registration: ImageRegistration, frames: int, off_px: float
) -> None:
    known = [evidence(*frame(seed + number, registration)) for number in range(frames)]
    found = estimate_registration(known)
    assert found.zoom == pytest.approx(registration.zoom, abs=0.012)
    shift = (registration.right, registration.down)
    assert (found.right, found.down) == pytest.approx(shift, abs=off_px)


NEARLY = ImageRegistration(zoom=1.0, right=2.0, down=0.0)


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize(
    ("registration", "count"),
    [(None, 20), (None, 100), (None, 500), (None, 4000), (NEARLY, 150), (UNREGISTERED, 80)],
)
def test_a_registered_image_stays_and_few_points_of_one_frame_move_none(
    seed: int, registration: ImageRegistration | None, count: int
) -> None:
    assert estimate_registration([evidence(*frame(seed, registration, count))]) is None


@pytest.mark.parametrize("gap_px", [5, 8])
def test_a_registered_image_stays_where_points_beside_jumps_are_missing(gap_px: int) -> None:
    known = [evidence(*frame(seed, count=500, gap_px=gap_px)) for seed in range(8)]
    assert None not in known
    assert estimate_registration(known) is None


@pytest.mark.parametrize(("count", "frames"), [(100, 6), (500, 5)])
def test_images_of_other_scenes_are_not_moved(count: int, frames: int) -> None:
    pairs = [
        (frame(seed + 20, count=count)[0], frame(seed, count=count)[1]) for seed in range(frames)
    ]
    assert estimate_registration([evidence(*pair) for pair in pairs]) is None


@pytest.mark.parametrize("without", ["rows of points", "jumps of depth", "edges of the image"])
def test_points_on_one_line_and_a_flat_depth_and_a_grey_image_register_nothing(
    without: str,
) -> None:
    rgb, points = frame(0, UNREGISTERED, count=4000)
    x, y = points.xy.unbind(1)
    if without == "rows of points":
        points = replace(points, xy=torch.stack([x, torch.full_like(y, 100.0)], dim=1))
    elif without == "jumps of depth":
        points = replace(points, depth=torch.full_like(x, 2.0))
    else:
        rgb = np.full_like(rgb, 0.5)
    shown = evidence(rgb, points)
    assert shown is None or estimate_registration([shown]) is None


def test_the_colour_of_a_pixel_is_where_the_registration_says() -> None:
    y, x = np.mgrid[:41, :61].astype(np.float32)
    ramp = np.stack([x, y, x + y], axis=-1)
    moved = ImageRegistration(zoom=0.5, right=4.0, down=-2.0).apply_to(ramp)
    assert moved[30, 40, 0] == pytest.approx(30 + 0.5 * (40 - 30) + 4)
    assert moved[30, 40, 1] == pytest.approx(20 + 0.5 * (30 - 20) - 2)


def test_the_likelihood_is_the_edges_under_the_moved_samples_and_the_answer_its_posterior() -> None:
    known = evidence(*frame(0, UNREGISTERED))
    likelihood = known.log_likelihood(1.1)
    assert likelihood.shape == (2 * 12 + 1, 2 * 16 + 1)  # shifts of 5 % of the sides
    height, width = known.edges.shape
    x, y = np.floor((known.between - (160, 120)) * 1.1 + (160, 120)).astype(int).T
    for down, right in ((0, 0), (-12, 16), (5, -7)):
        column = x + right
        row = y + down
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        edges = known.edges[row[inside], column[inside]]
        expected = float(known.weight[inside] @ edges)
        assert likelihood[12 + down, 16 + right] == pytest.approx(expected, abs=0.01)
    # The prior is exponential in the log of the zoom and normal in the shift.
    zooms = np.exp(np.linspace(-0.4, 0.4, 81))
    total = np.stack([known.log_likelihood(zoom) for zoom in zooms])
    down, right = np.mgrid[-12:13, -16:17]
    prior = -np.abs(np.log(zooms))[:, None, None] / 0.07 - (
        (down / height) ** 2 + (right / width) ** 2
    ) / (2 * 0.025**2)
    posterior = np.exp(total + prior - (total + prior).max())
    posterior /= posterior.sum()
    mean = [(posterior * value).sum() for value in (zooms[:, None, None], right, down)]
    found = estimate_registration([known])
    assert found.zoom == round(mean[0], 4)
    assert (found.right, found.down) == (round(mean[1], 2), round(mean[2], 2))


def turned(points: SparsePoints, across: bool, down: bool) -> SparsePoints:
    """The points mirrored left to right, upside down, or both."""
    height, width = points.size
    x, y = points.xy.unbind(dim=1)
    x = width - 1 - x if across else x
    y = height - 1 - y if down else y
    return replace(points, xy=torch.stack([x, y], dim=1))


@pytest.mark.parametrize(
    ("across", "down", "said"),
    [(True, False, "left to right"), (False, True, "upside down"), (True, True, "180°")],
)
def test_depth_that_is_mirrored_or_turned_is_told_and_moves_nothing(
    across: bool, down: bool, said: str
) -> None:
    for seed in range(3):
        rgb, points = frame(seed, None, 2000)
        known = evidence(rgb, turned(points, across, down))
        assert known is not None
        assert said in str(better_orientation([known]))
        assert estimate_registration([known]) is None


@pytest.mark.parametrize(
    ("of_depth", "said"),
    [
        (lambda x, y, last: (y, last - x), "turned by 90°"),
        (lambda x, y, last: (last - y, x), "turned by −90°"),
        (lambda x, y, last: (y, x), "exchanged"),
        (lambda x, y, last: (last - y, last - x), "exchanged, and turned by 180°"),
    ],
)
def test_in_a_square_image_quarter_turns_and_exchanged_axes_are_told(
    of_depth: Callable[[Tensor, Tensor, int], tuple[Tensor, Tensor]], said: str
) -> None:
    side = SIZE[0]
    rgb, points = frame(0, None, 3000)
    inside = points.select(points.xy[:, 0] < side)
    x, y = inside.xy.unbind(dim=1)
    xy = torch.stack(of_depth(x, y, side - 1), dim=1)
    known = evidence(np.ascontiguousarray(rgb[:, :side]), replace(inside, xy=xy, size=(side, side)))
    assert known is not None
    assert str(better_orientation([known])).endswith(said)


@pytest.mark.parametrize("count", [100, 500, 2000])
def test_no_other_orientation_is_better_than_a_right_one(count: int) -> None:
    for seed in range(6):
        known = evidence(*frame(seed, None, count))
        assert known is None or better_orientation([known]) is None


def test_an_image_that_a_turn_of_the_camera_moved_by_little_stays() -> None:
    late = ImageRegistration(zoom=1.0, right=5.0, down=2.0)  # of 320 pixels
    for seed in range(3):
        assert estimate_registration([evidence(*frame(seed, late, 4000))]) is None


@pytest.mark.parametrize("seed", [2, 3])
def test_what_fits_better_in_a_corner_of_the_image_only_moves_no_image(seed: int) -> None:
    known = evidence(*frame(seed, UNREGISTERED, 2000))
    x, y = known.between.T
    of_corner = (x < 120) & (y < 100)
    corner = replace(known, between=known.between[of_corner], weight=known.weight[of_corner])
    assert estimate_registration([known]) is not None
    assert estimate_registration([corner]) is None
