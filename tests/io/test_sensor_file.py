from __future__ import annotations

from pathlib import Path

import pytest

from pnpdepth_cli.errors import FileFormatError
from pnpdepth_cli.io.sensor_file import read_sensor


def write(folder: Path, text: str) -> Path:
    path = folder / "mine.toml"
    path.write_text(text)
    return path


def test_listed_elevations_are_taken_as_they_stand(tmp_path: Path) -> None:
    text = 'name = "five"\nelevations_deg = [10, 5, 0.5, -5, -10]\nazimuth_step_deg = 0.2\n'
    got = read_sensor(write(tmp_path, text + "max_range = 80\nrange_noise = 0.02\n"))
    assert got == {
        "name": "five",
        "elevations_deg": (10, 5, 0.5, -5, -10),
        "azimuth_step_deg": 0.2,
        "max_range": 80,
        "range_noise": 0.02,
    }


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("elevations_deg = [1\n", "not valid TOML"),
        ("elevations_deg = [1]\n", "azimuth_step_deg is missing"),
        ("elevations_deg = []\nazimuth_step_deg = 1\n", "not a list of at most"),
        ("elevations_deg = [1]\ntop_deg = 1\nazimuth_step_deg = 1\n", "not both"),
        ("top_deg = 1\nstep_deg = 1\nbeams = 1.5\nazimuth_step_deg = 1\n", "whole number"),
        ("elevations_deg = [1]\nazimut_step_deg = 1\n", "'azimut_step_deg' is not part"),
        ("elevations_deg = [nan]\nazimuth_step_deg = 1\n", "not a number"),
        ("elevations_deg = " + "[" * 5000 + "]" * 5000, "not valid TOML"),
        ("elevations_deg = [1]\nazimuth_step_deg = 1" + "0" * 400 + "\n", "not a number"),
        (f"elevations_deg = {[0] * 300_000}\nazimuth_step_deg = 1\n", "at most 4,096 degrees"),
    ],
    ids=range(10),
)
def test_what_is_missing_or_wrong_is_named_in_one_line(
    tmp_path: Path, text: str, message: str
) -> None:
    with pytest.raises(FileFormatError) as error:
        read_sensor(write(tmp_path, text))
    assert message in str(error.value)
    assert "\n" not in str(error.value)
    assert len(str(error.value)) < 500
