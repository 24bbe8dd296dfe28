"""Rotating LiDARs: those of the data sheets and the paper, and what they measure."""

from __future__ import annotations

import numpy as np
import pytest

from pnpdepth_cli.camera import Camera
from pnpdepth_cli.errors import NoPointsError, UsageError
from pnpdepth_cli.sensors.lidar import LIDARS, Lidar, ideal_lidar, simulate_lidar


@pytest.mark.parametrize(
    ("name", "beams", "top", "bottom"),
    [
        ("vlp-16", 16, 15.0, -15.0),
        ("vlp-32c", 32, 15.0, -25.0),
        ("hdl-32e", 32, 10.67, -30.67),
        ("hdl-64e", 64, 2.0, -24.33),
    ],
)
def test_a_sensor_has_the_beams_of_its_data_sheet_from_the_top(
    name: str, beams: int, top: float, bottom: float
) -> None:
    angles = np.array(LIDARS[name].elevations_deg)
    assert len(angles) == beams
    assert (np.diff(angles) < 0).all()
    assert (angles[0], angles[-1]) == pytest.approx((top, bottom), abs=0.01)


def test_a_lidar_of_ones_own_has_evenly_spaced_beams_and_no_noise() -> None:
    own = ideal_lidar(5, 15, -25)
    assert own == Lidar(
        name="5 beams", elevations_deg=(15, 5, -5, -15, -25), azimuth_step_deg=0.2, max_range=np.inf
    )
    assert ideal_lidar(1, 3, 3).elevations_deg == (3,)
    for top, bottom in ((-25, 15), (3, 3), (np.nan, 0)):
        with pytest.raises(UsageError):
            ideal_lidar(5, top, bottom)
    with pytest.raises(UsageError):
        ideal_lidar(2, 91, 0)


K = np.array([[300.0, 0, 159.5], [0, 300, 119.5], [0, 0, 1]])
CAMERA = Camera(intrinsics=K)
IDEAL = Lidar(
    name="ideal", elevations_deg=tuple(range(-14, 15, 2)), azimuth_step_deg=0.2, max_range=100
)


def test_without_noise_every_point_lies_on_the_depth_map() -> None:
    depth = np.random.default_rng(0).uniform(2, 50, (240, 320)).astype(np.float32)
    got = simulate_lidar(depth, CAMERA, IDEAL, seed=0)
    column, row = np.floor(got.xy + 0.5).astype(int).T
    np.testing.assert_allclose(got.depth, depth[row, column], rtol=1e-6)
    assert len(got.depth) > 1000


def test_unknown_depth_gives_no_points() -> None:
    with pytest.raises(NoPointsError, match="ideal"):
        simulate_lidar(np.zeros((240, 320)), CAMERA, IDEAL, seed=0)
    half = np.full((240, 320), 5.0)
    half[:, :160] = 0
    assert simulate_lidar(half, CAMERA, IDEAL, seed=0).xy[:, 0].min() >= 159.5


PAPER_PERCENT = {"vlp-16": 5.3, "vlp-32c": 28.8, "hdl-32e": 10.3, "hdl-64e": 18.7}


def test_the_papers_sensors_give_about_its_fractions_of_samples() -> None:
    # SYNTHIA's sequences are 1280×760 with a focal length of 532.74; at 0.4 of that size
    intrinsics = np.array([[213.1, 0, 255.5], [0, 213.1, 151.5], [0, 0, 1]])
    synthia = Camera(intrinsics=intrinsics)
    depth = np.full((304, 512), 10.0)
    for name, percent in PAPER_PERCENT.items():
        points = simulate_lidar(depth, synthia, LIDARS[f"paper-{name}"], 0)
        assert 100 * len(points) / depth.size == pytest.approx(percent, rel=0.1), name
