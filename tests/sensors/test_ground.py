"""How far a scanner is above the ground, of scans and of made ones."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pnpdepth_cli.io.calibration import read_calibration
from pnpdepth_cli.io.scans import read_scan
from pnpdepth_cli.sensors.ground import height_above_ground

STREET = Path(__file__).parents[2] / "samples" / "street"


@pytest.mark.parametrize("scale", [1.0, 3.28084, 10.0])
@pytest.mark.parametrize("tilt_deg", [0.0, -8.0, 8.0])
def test_the_height_of_the_samples_scanner_is_found_in_its_unit(
    scale: float, tilt_deg: float
) -> None:
    scan = read_scan(STREET / "000000.bin")[0]
    scanner = read_calibration(STREET / "calib.txt").scanner
    assert scanner is not None
    tilt = Rotation.from_euler("x", tilt_deg, degrees=True).as_matrix()
    height = height_above_ground(scale * scan @ (tilt @ scanner.rotation).T)
    assert height == pytest.approx(1.73 * scale, rel=0.07)


def test_there_is_no_height_above_points_that_are_on_no_plane() -> None:
    rng = np.random.default_rng(0)
    assert height_above_ground(rng.normal(0, 10, (5000, 3))) is None
    assert height_above_ground(rng.normal(0, 10, (50, 3))) is None


def test_a_wall_is_no_ground() -> None:
    rng = np.random.default_rng(0)
    wall = np.column_stack([rng.uniform(-5, 5, 4000), rng.uniform(-3, 3, 4000), np.full(4000, 6.0)])
    assert height_above_ground(wall) is None
