from __future__ import annotations

import numpy as np
import pytest

from pnpdepth_cli.camera import Camera
from pnpdepth_cli.errors import NoPointsError
from pnpdepth_cli.sensors.lidar import LIDARS, Lidar, simulate_lidar

K = np.array([[300.0, 0, 159.5], [0, 300, 119.5], [0, 0, 1]])
CAMERA = Camera(intrinsics=K)
IDEAL = Lidar(
    name="ideal", elevations_deg=tuple(range(-14, 15, 2)), azimuth_step_deg=0.2, max_range=100
)


def rows_of(xy: np.ndarray) -> np.ndarray:
    return np.floor(xy + 0.5).astype(int)


def test_without_noise_every_point_lies_on_the_depth_map() -> None:
    depth = np.random.default_rng(0).uniform(2, 50, (240, 320)).astype(np.float32)
    got = simulate_lidar(depth, CAMERA, IDEAL, seed=0)
    column, row = rows_of(got.xy).T
    np.testing.assert_allclose(got.depth, depth[row, column], rtol=1e-6)
    assert len(got.depth) > 1000


def test_unknown_depth_gives_no_points() -> None:
    with pytest.raises(NoPointsError, match="ideal"):
        simulate_lidar(np.zeros((240, 320)), CAMERA, IDEAL, seed=0)
    half = np.full((240, 320), 5.0)
    half[:, :160] = 0
    assert simulate_lidar(half, CAMERA, IDEAL, seed=0).xy[:, 0].min() >= 159.5


PAPER_PERCENT = {"vlp-16": 5.3, "vlp-32c": 28.8, "hdl-32e": 10.3, "hdl-64e": 18.7}


def test_the_papers_sensors_give_about_its_fractions_of_samples_in_its_order() -> None:
    # SYNTHIA's sequences are 1280×760 with a focal length of 532.74; at 0.4 of that size
    intrinsics = np.array([[213.1, 0, 255.5], [0, 213.1, 151.5], [0, 0, 1]])
    synthia = Camera(intrinsics=intrinsics)
    depth = np.full((304, 512), 10.0)
    fractions = {
        name: 100
        * len(simulate_lidar(depth, synthia, LIDARS[f"paper-{name}"], 0).depth)
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
