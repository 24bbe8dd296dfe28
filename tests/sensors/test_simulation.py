"""Points sampled from dense depth, and those that rotating LiDARs measure there."""

from __future__ import annotations

import numpy as np
import pytest

from pnpdepth_cli.camera import Camera
from pnpdepth_cli.choices import PATTERNS
from pnpdepth_cli.errors import NoPointsError, SizeError, UsageError
from pnpdepth_cli.file_record import SamplePattern
from pnpdepth_cli.sensors.simulation import (
    LIDARS,
    ideal_lidar,
    sample_points,
    simulate_lidar,
)


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
    angles = np.array(LIDARS[name].elevations_deg)
    assert len(angles) == beams
    assert (np.diff(angles) < 0).all()
    assert (angles[0], angles[-1]) == pytest.approx((top, bottom), abs=0.01)
    # SYNTHIA's sequences are 1280×760 with a focal length of 532.74; at 0.4 of that size
    synthia = Camera(intrinsics=np.array([[213.1, 0, 255.5], [0, 213.1, 151.5], [0, 0, 1]]))
    depth = np.full((304, 512), 10.0)
    points = simulate_lidar(depth, synthia, LIDARS[f"paper-{name}"], 0)
    assert 100 * len(points) / depth.size == pytest.approx(percent, rel=0.1)


def test_a_lidar_of_ones_own_has_evenly_spaced_beams() -> None:
    assert ideal_lidar(5, 15, -25).elevations_deg == (15, 5, -5, -15, -25)
    assert ideal_lidar(1, 3, 3).elevations_deg == (3,)
    assert len(ideal_lidar(5, 15, -25).directions(np.random.default_rng(0))) == 5 * 1800
    for beams, top, bottom in ((5, -25, 15), (5, 3, 3), (5, np.nan, 0), (2, 91, 0)):
        with pytest.raises(UsageError):
            ideal_lidar(beams, top, bottom)


def test_without_noise_every_point_lies_on_known_depth() -> None:
    camera = Camera(intrinsics=np.array([[300.0, 0, 159.5], [0, 300, 119.5], [0, 0, 1]]))
    depth = np.random.default_rng(0).uniform(2, 50, (240, 320)).astype(np.float32)
    depth[:, :160] = 0
    got = simulate_lidar(depth, camera, ideal_lidar(15, 14, -14), seed=0)
    column, row = np.floor(got.xy + 0.5).astype(int).T
    np.testing.assert_allclose(got.depth, depth[row, column], rtol=1e-6)
    assert len(got.depth) > 1000
    with pytest.raises(NoPointsError, match="15 beams"):
        simulate_lidar(0 * depth, camera, ideal_lidar(15, 14, -14), seed=0)


DEPTH = np.random.default_rng(7).uniform(1, 9, (60, 80)).astype(np.float32)
HOLES = np.where(np.random.default_rng(8).random((60, 80)) < 0.3, 0, DEPTH).astype(np.float32)


def checkerboard() -> np.ndarray:
    y, x = np.mgrid[:60, :80]
    board = (((y // 12) + (x // 12)) % 2).astype(np.float32)
    return np.repeat(board[:, :, None], 3, axis=2)


@pytest.mark.parametrize("kind", PATTERNS)
def test_every_pattern_gives_known_pixels_once_with_their_own_depth(kind: str) -> None:
    pattern = SamplePattern(kind=kind, count=9 if kind == "lines" else 40)
    got = sample_points(HOLES, pattern, 1, image=checkerboard())
    column, row = got.xy.astype(int).T
    assert np.array_equal(got.xy, np.column_stack([column, row]))
    assert np.array_equal(got.depth, HOLES[row, column])
    assert (got.depth > 0).all()
    assert len({*zip(row, column, strict=True)}) == len(row)


@pytest.mark.parametrize("count", [1, 40, 3000])
def test_uniform_returns_exactly_the_requested_number(count: int) -> None:
    known = np.count_nonzero(HOLES)
    assert len(sample_points(HOLES, SamplePattern(count=count), 1)) == count
    some = sample_points(HOLES, SamplePattern(fraction=count / 4000), 1)
    assert len(some) == round(count / 4000 * known)


def test_grid_gives_evenly_spaced_points_of_about_the_number() -> None:
    got = sample_points(DEPTH, SamplePattern(kind="grid", count=48), 0)
    assert len(got.depth) == 48  # 6 × 8 at a spacing of 10
    assert set(np.diff(np.unique(got.xy[:, 0]))) == {10}
    assert set(np.diff(np.unique(got.xy[:, 1]))) == {10}
    ones = np.ones((6, 6), np.float32)
    for fraction, (a, b) in ((1 / 9, (1, 4)), (1 / 16, (2, 5))):
        few = sample_points(ones, SamplePattern(kind="grid", fraction=fraction), 0)
        assert few.xy.tolist() == [[a, a], [b, a], [a, b], [b, b]]


def test_lines_keeps_whole_rows() -> None:
    got = sample_points(DEPTH, SamplePattern(kind="lines", count=4), 0)
    assert np.unique(got.xy[:, 1]).tolist() == [7, 22, 37, 52]
    assert len(got.depth) == 4 * 80
    every = sample_points(DEPTH, SamplePattern(kind="lines", count=60), 0)
    assert np.array_equal(every.depth, DEPTH.ravel())


def test_features_lie_at_the_corners_of_the_image() -> None:
    image = np.full((160, 200, 3), 0.2, np.float32)
    image[40:120, 20:150] = 0.9
    image[10:30, 170:190] = 0.3  # its corners are weaker
    depth = np.full((160, 200), 3, np.float32)
    got = sample_points(depth, SamplePattern(kind="features", count=8), 0, image=image)
    corners = np.array([[20, 40], [149, 40], [20, 119], [149, 119]])
    away = np.abs(got.xy[:, None] - corners).max(axis=2)
    assert away.min(axis=1).max() <= 6
    assert len(got.depth) == 8
    assert (away.min(axis=0) <= 6).all()


PLAIN = np.full((60, 80, 3), 0.5, np.float32)


@pytest.mark.parametrize(
    ("depth", "kind", "count", "image", "error"),
    [
        (0 * DEPTH, "uniform", 1, None, NoPointsError),
        (DEPTH, "uniform", 4801, None, UsageError),
        (DEPTH, "features", 3, PLAIN, NoPointsError),
        (DEPTH, "features", 3, None, UsageError),
        (DEPTH, "features", 3, PLAIN[:30], SizeError),
        (DEPTH, "lines", 61, None, UsageError),
    ],
)
def test_what_the_depth_map_cannot_give_is_refused(
    depth: np.ndarray, kind: str, count: int, image: np.ndarray | None, error: type[Exception]
) -> None:
    with pytest.raises(error):
        sample_points(depth, SamplePattern(kind=kind, count=count), 0, image=image)
