"""Points sampled from dense depth, and those that rotating LiDARs measure there."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from pnpdepth_cli import choices
from pnpdepth_cli.camera import Camera
from pnpdepth_cli.errors import InputError, NoPointsError, UsageError
from pnpdepth_cli.file_record import PATTERNS, SamplePattern
from pnpdepth_cli.sensors.projection import Points
from pnpdepth_cli.sensors.simulation import lidar_of, sample_points, simulate_lidar


@pytest.mark.parametrize(
    ("name", "beams", "top", "bottom", "percent"),
    [
        ("vlp-16", 16, 15.0, -15.0, 5.3),
        ("vlp-32c", 32, 15.0, -25.0, 28.8),
        ("hdl-32e", 32, 10.67, -30.67, 10.3),
        ("hdl-64e", 64, 2.0, -24.33, 18.7),
    ],
)
def test_a_sensor_has_the_beams_of_its_data_sheet_and_the_papers_fraction_of_samples(
    name: str, beams: int, top: float, bottom: float, percent: float
) -> None:
    angles = np.array(choices.SENSORS[name].elevations_deg)
    assert len(angles) == beams
    assert (np.diff(angles) < 0).all()
    assert (angles[0], angles[-1]) == pytest.approx((top, bottom), abs=0.01)
    # SYNTHIA's sequences are 1280×760 with a focal length of 532.74; at 0.4 of that size
    synthia = Camera(intrinsics=np.array([[213.1, 0, 255.5], [0, 213.1, 151.5], [0, 0, 1]]))
    depth = np.full((304, 512), 10.0)
    points = simulate_lidar(depth, synthia, choices.SENSORS[f"paper-{name}"], 0)
    assert 100 * len(points) / depth.size == pytest.approx(percent, rel=0.1)


def test_the_beams_of_a_lidar_of_ones_own_are_evenly_spaced_from_top_to_bottom() -> None:
    assert lidar_of(None, 5, (15, -25)).elevations_deg == (15, 5, -5, -15, -25)
    assert lidar_of(None, 1, (3, 3)).elevations_deg == (3,)
    assert lidar_of(None, 3, (90, -90)).elevations_deg == (90, 0, -90)


def test_each_beam_of_a_lidar_of_ones_own_has_1800_directions_a_turn() -> None:
    assert len(lidar_of(None, 5, (15, -25)).directions(np.random.default_rng(0))) == 5 * 1800


@pytest.mark.parametrize(
    ("beams", "top", "bottom"), [(5, -25, 15), (5, 3, 3), (5, np.nan, 0), (2, 91, 0)]
)
def test_beams_that_no_lidar_can_have_are_refused(beams: int, top: float, bottom: float) -> None:
    with pytest.raises(UsageError):
        lidar_of(None, beams, (top, bottom))


CAMERA = Camera(intrinsics=np.array([[300.0, 0, 159.5], [0, 300, 119.5], [0, 0, 1]]))


def half_known_depth() -> np.ndarray:
    """A map (240, 320) whose left half is unknown."""
    depth = np.random.default_rng(0).uniform(2, 50, (240, 320)).astype(np.float32)
    depth[:, :160] = 0
    return depth


def test_a_lidar_of_ones_own_measures_the_depth_of_the_pixel_it_hits_where_it_is_known() -> None:
    depth = half_known_depth()
    got = simulate_lidar(depth, CAMERA, lidar_of(None, 15, (14, -14)), seed=0)  # without noise
    column, row = np.floor(got.xy + 0.5).astype(int).T
    np.testing.assert_allclose(got.depth, depth[row, column], rtol=1e-6)
    assert len(got.depth) > 1000


def test_a_lidar_that_hits_no_known_depth_is_an_error_that_names_its_beams() -> None:
    with pytest.raises(NoPointsError, match="15 beams"):
        simulate_lidar(0 * half_known_depth(), CAMERA, lidar_of(None, 15, (14, -14)), seed=0)


DEPTH = np.random.default_rng(7).uniform(1, 9, (60, 80)).astype(np.float32)
HOLES = np.where(np.random.default_rng(8).random((60, 80)) < 0.3, 0, DEPTH).astype(np.float32)
BOARD = np.repeat(np.indices((60, 80, 1)).sum(axis=0) // 12 % 2, 3, axis=2).astype(np.float32)
PLAIN = np.full((60, 80, 3), 0.5, np.float32)


def sampled(depth: np.ndarray, image: np.ndarray | None = None, **pattern: Any) -> Points:
    return sample_points(depth, SamplePattern(**pattern), 1, image=image)


@pytest.mark.parametrize("kind", PATTERNS)
def test_every_pattern_gives_known_pixels_once_with_their_own_depth(kind: str) -> None:
    got = sampled(HOLES, BOARD, kind=kind, count=9 if kind == "lines" else 40)
    column, row = got.xy.astype(int).T
    assert np.array_equal(got.xy, np.column_stack([column, row]))
    assert np.array_equal(got.depth, HOLES[row, column])
    assert (got.depth > 0).all()
    assert len({*zip(row, column, strict=True)}) == len(row)


@pytest.mark.parametrize("count", [1, 40, 3000])
def test_uniform_returns_exactly_the_requested_number(count: int) -> None:
    assert len(sampled(HOLES, count=count)) == count
    expected = round(count / 4000 * np.count_nonzero(HOLES))
    assert len(sampled(HOLES, fraction=count / 4000)) == expected


@pytest.mark.parametrize(
    ("size", "pattern", "rows", "columns"),
    [
        ((60, 80), {"kind": "grid", "count": 48}, range(5, 60, 10), range(5, 80, 10)),
        ((6, 6), {"kind": "grid", "fraction": 1 / 9}, [1, 4], [1, 4]),
        ((6, 6), {"kind": "grid", "fraction": 1 / 16}, [2, 5], [2, 5]),
        ((60, 80), {"kind": "lines", "count": 4}, [7, 22, 37, 52], range(80)),
        ((60, 80), {"kind": "lines", "count": 60}, range(60), range(80)),
    ],
)
def test_grids_and_lines_are_evenly_spaced(
    size: tuple[int, int], pattern: dict[str, Any], rows: Sequence[int], columns: Sequence[int]
) -> None:
    got = sampled(np.ones(size, np.float32), **pattern)
    assert got.xy.tolist() == [[column, row] for row in rows for column in columns]


def test_features_lie_at_the_corners_of_the_image() -> None:
    image = np.full((160, 200, 3), 0.2, np.float32)
    image[40:120, 20:150] = 0.9
    image[10:30, 170:190] = 0.3  # its corners are weaker
    depth = np.full((160, 200), 3, np.float32)
    got = sampled(depth, image, kind="features", count=8)
    corners = np.array([[20, 40], [149, 40], [20, 119], [149, 119]])
    away = np.abs(got.xy[:, None] - corners).max(axis=2)
    assert away.min(axis=1).max() <= 6
    assert len(got.depth) == 8
    assert (away.min(axis=0) <= 6).all()


@pytest.mark.parametrize(
    ("depth", "kind", "count", "image", "error"),
    [
        (0 * DEPTH, "uniform", 1, None, NoPointsError),
        (DEPTH, "uniform", 4801, None, UsageError),
        (DEPTH, "features", 3, PLAIN, NoPointsError),
        (DEPTH, "features", 3, None, UsageError),
        (DEPTH, "features", 3, PLAIN[:30], InputError),
        (DEPTH, "lines", 61, None, UsageError),
    ],
)
def test_what_the_depth_map_cannot_give_is_refused(
    depth: np.ndarray, kind: str, count: int, image: np.ndarray | None, error: type[Exception]
) -> None:
    with pytest.raises(error):
        sampled(depth, image, kind=kind, count=count)
