from __future__ import annotations

import numpy as np
import pytest

from pnpdepth_cli.errors import UsageError
from pnpdepth_cli.sensors.lidar import LIDARS, Lidar, ideal_lidar


@pytest.mark.parametrize(
    ("name", "beams", "top", "bottom", "step", "most_m", "noise_m"),
    [
        ("vlp-16", 16, 15.0, -15.0, 0.2, 100, 0.03),
        ("vlp-32c", 32, 15.0, -25.0, 0.2, 200, 0.03),
        ("hdl-32e", 32, 10.67, -30.67, 0.166, 100, 0.02),
        ("hdl-64e", 64, 2.0, -24.33, 0.1728, 120, 0.02),
    ],
)
def test_a_sensor_is_that_of_its_data_sheet(
    name: str, beams: int, top: float, bottom: float, step: float, most_m: float, noise_m: float
) -> None:
    sensor, angles = LIDARS[name], np.array(LIDARS[name].elevations_deg)
    assert len(angles) == beams
    assert (np.diff(angles) < 0).all()
    assert (angles[0], angles[-1]) == pytest.approx((top, bottom), abs=0.01)
    assert (sensor.azimuth_step_deg, sensor.max_range, sensor.range_noise) == (
        *(step, most_m, noise_m),
    )


def test_the_beams_of_the_vlp_32c_are_those_of_its_manual_in_the_order_of_firing() -> None:
    manual = [
        -25, -1, -1.667, -15.639, -11.31, 0, -0.667, -8.843, -7.254, 0.333, -0.333, -6.148, -5.333,
        1.333, 0.667, -4, -4.667, 1.667, 1, -3.667, -3.333, 3.333, 2.333, -2.667, -3, 7, 4.667,
        -2.333, -2, 15, 10.333, -1.333,
    ]  # fmt: skip
    assert sorted(LIDARS["vlp-32c"].elevations_deg) == sorted(manual)


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
