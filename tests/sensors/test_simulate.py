from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pnpdepth_cli.camera import Camera, Extrinsics
from pnpdepth_cli.errors import NoPointsError
from pnpdepth_cli.sensors import FORWARD_LEFT_UP, LIDARS, Lidar, simulate_lidar
from pnpdepth_cli.sensors.lens import unproject

K = np.array([[300.0, 0, 159.5], [0, 300, 119.5], [0, 0, 1]])
CAMERA = Camera(intrinsics=K)
HERE = Extrinsics(FORWARD_LEFT_UP, np.zeros(3))
IDEAL = Lidar(
    name="ideal", elevations_deg=tuple(range(-14, 15, 2)), azimuth_step_deg=0.2, max_range=100
)


def rows_of(xy: np.ndarray) -> np.ndarray:
    return np.floor(xy + 0.5).astype(int)


def test_without_noise_every_point_lies_on_the_depth_map() -> None:
    depth = np.random.default_rng(0).uniform(2, 50, (240, 320)).astype(np.float32)
    got = simulate_lidar(depth, CAMERA, HERE, IDEAL, seed=0)
    column, row = rows_of(got.xy).T
    np.testing.assert_allclose(got.depth, depth[row, column], rtol=1e-6)
    assert len(got.depth) > 1000


@pytest.mark.parametrize("translation", [(0.3, 0.0, 0.0), (0.0, -0.8, -0.3), (-0.5, 0.4, 0.5)])
def test_from_another_position_every_point_lies_on_the_wall_it_hits(
    translation: tuple[float, float, float],
) -> None:
    # a wall that runs away to the right: n · p = 6 with n = (-0.4, 0, 1)
    x = (np.arange(320) - K[0, 2]) / K[0, 0]
    depth = np.broadcast_to(6 / (1 - 0.4 * x), (240, 320))
    scanner = Extrinsics(FORWARD_LEFT_UP, np.array(translation))
    got = simulate_lidar(depth, CAMERA, scanner, IDEAL, seed=0)
    points = unproject(CAMERA, got.xy, got.depth)
    np.testing.assert_allclose(points @ [-0.4, 0, 1], 6, atol=0.02)
    seen = scanner.inverse().moved(points)
    elevation = np.degrees(np.arctan2(seen[:, 2], np.hypot(seen[:, 0], seen[:, 1])))
    np.testing.assert_allclose(elevation, 2 * np.rint(elevation / 2), atol=1e-3)
    assert set(np.rint(elevation).astype(int)) == set(range(-14, 15, 2))
    assert len(got.depth) > 1000
    nearer = Extrinsics(FORWARD_LEFT_UP, scanner.translation / 10)
    scaled = simulate_lidar(depth / 10, CAMERA, nearer, IDEAL, 0)
    np.testing.assert_allclose(scaled.xy, got.xy, atol=1e-3)


def test_what_is_behind_an_edge_for_the_scanner_is_not_measured() -> None:
    # a board at 3 m in the middle columns before a wall at 12 m; the scanner 1 m to the right
    depth = np.full((240, 320), 12.0)
    depth[:, 130:190] = 3.0
    scanner = Extrinsics(FORWARD_LEFT_UP, np.array([1.0, 0.0, 0.0]))
    got = simulate_lidar(depth, CAMERA, scanner, replace(IDEAL, azimuth_step_deg=0.05), seed=0)
    column, row = rows_of(got.xy).T
    np.testing.assert_allclose(got.depth, depth[row, column], rtol=1e-6)
    wall = got.depth > 6
    edge_left = unproject(CAMERA, np.array([[129.5, 120.0]]), np.array([3.0]))[0, 0]
    # the scanner's line of sight past the board's left edge meets the wall at:
    shadow_end = 1.0 + (edge_left - 1.0) * 12 / 3
    x = unproject(CAMERA, got.xy[wall], got.depth[wall])[:, 0]
    left_of_board = x < edge_left * 12 / 3
    assert left_of_board.any()
    assert x[left_of_board].max() <= shadow_end + 0.05


def test_unknown_depth_gives_no_points() -> None:
    with pytest.raises(NoPointsError, match="ideal"):
        simulate_lidar(np.zeros((240, 320)), CAMERA, HERE, IDEAL, seed=0)
    half = np.full((240, 320), 5.0)
    half[:, :160] = 0
    assert simulate_lidar(half, CAMERA, HERE, IDEAL, seed=0).xy[:, 0].min() >= 159.5


PAPER_PERCENT = {"vlp-16": 5.3, "vlp-32c": 28.8, "hdl-32e": 10.3, "hdl-64e": 18.7}


def test_the_papers_sensors_give_about_its_fractions_of_samples_in_its_order() -> None:
    # SYNTHIA's sequences are 1280×760 with a focal length of 532.74; at 0.4 of that size
    intrinsics = np.array([[213.1, 0, 255.5], [0, 213.1, 151.5], [0, 0, 1]])
    synthia = Camera(intrinsics=intrinsics)
    depth = np.full((304, 512), 10.0)
    fractions = {
        name: 100
        * len(simulate_lidar(depth, synthia, HERE, LIDARS[f"paper-{name}"], 0).depth)
        / depth.size
        for name in PAPER_PERCENT
    }
    assert sorted(fractions, key=fractions.__getitem__) == [
        "vlp-16",
        "hdl-32e",
        "hdl-64e",
        "vlp-32c",
    ]
    for name, percent in PAPER_PERCENT.items():
        assert fractions[name] == pytest.approx(percent, rel=0.1), name
