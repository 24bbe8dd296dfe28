from __future__ import annotations

import numpy as np
import pytest

from pnpdepth_cli.errors import UsageError
from pnpdepth_cli.sensors import LIDARS, Lidar


@pytest.mark.parametrize(
    ("name", "beams", "top", "bottom"),
    [
        ("vlp-16", 16, 15.0, -15.0),
        ("vlp-32c", 32, 15.0, -25.0),
        ("hdl-32e", 32, 10.67, -30.67),
        ("hdl-64e", 64, 2.0, -24.33),
    ],
)
def test_a_sensor_has_the_beams_of_its_data_sheet(
    name: str, beams: int, top: float, bottom: float
) -> None:
    angles = np.array(LIDARS[name].elevations_deg)
    assert len(angles) == beams
    assert (np.diff(angles) < 0).all()
    assert angles[0] == pytest.approx(top, abs=0.01)
    assert angles[-1] == pytest.approx(bottom, abs=0.01)


@pytest.mark.parametrize(
    ("name", "fov", "step"),
    [("vlp-16", 30, 2.0), ("vlp-32c", 40, 0.3), ("hdl-32e", 41, 1.3), ("hdl-64e", 27, 0.4)],
)
def test_the_papers_variant_is_evenly_spaced_over_its_field_of_view(
    name: str, fov: float, step: float
) -> None:
    angles = np.array(LIDARS[f"paper-{name}"].elevations_deg)
    np.testing.assert_allclose(np.diff(angles), -step, atol=1e-5)
    assert fov - step < angles[0] - angles[-1] <= fov + 1e-5


def test_directions_are_unit_vectors_at_the_sensors_angles() -> None:
    sensor = Lidar(name="two", elevations_deg=(30, -10), azimuth_step_deg=90, max_range=10)
    beams = sensor.directions(np.random.default_rng(0)).reshape(2, 4, 3)
    np.testing.assert_allclose(np.linalg.norm(beams, axis=2), 1)
    np.testing.assert_allclose(beams[0, 0], [np.cos(np.pi / 6), 0, 0.5], atol=1e-12)
    np.testing.assert_allclose(beams[1, 1, :2], [0, np.cos(np.radians(10))], atol=1e-12)


@pytest.mark.parametrize(
    "values",
    [
        {"elevations_deg": ()},
        {"elevations_deg": (91.0,)},
        {"elevations_deg": (float("nan"),)},
        {"azimuth_step_deg": 0.0},
        {"max_range": 0.0},
        {"range_noise": -0.1},
        {"dropout": 1.0},
        {"rotation_noise_deg": float("nan")},
    ],
)
def test_a_sensor_that_cannot_be_is_refused(values: dict[str, object]) -> None:
    right = {"name": "x", "elevations_deg": (0.0,), "azimuth_step_deg": 1.0, "max_range": 5.0}
    with pytest.raises(UsageError, match="sensor 'x'"):
        Lidar(**(right | values))  # type: ignore[arg-type]
