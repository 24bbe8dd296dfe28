from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pnpdepth_cli.io.depth import describe_range, implausible, read_depth


def test_the_summary_has_count_range_and_what_was_assumed() -> None:
    depth = np.linspace(2.125, 63.4, 1842)
    line = describe_range(depth, "16-bit PNG ÷ 256", assumed_scale=True)
    assert line == "1,842 points, 2.1–63.4 m (16-bit PNG ÷ 256; --depth-scale to change)"


def test_unknown_depth_does_not_count_and_one_is_singular() -> None:
    assert describe_range(np.array([0, np.nan, 5.0]), "PFM") == "1 point, 5.0 m (PFM)"
    assert describe_range(np.zeros(3), "PFM", noun="pixels") == ("no pixels with known depth (PFM)")


@pytest.mark.parametrize(
    ("low", "high", "text"),
    [
        (0.4, 9.96, "0.4–10.0 m"),
        (0.034, 0.97, "0.034–1.0 m"),
        (12, 12345.6, "12.0–12,345.6 m"),
        (0.0001, 2, "1.0e-04–2.0 m"),
    ],
)
def test_numbers_are_written_as_people_do(low: float, high: float, text: str) -> None:
    assert text in describe_range(np.array([low, high]), "x")


@pytest.mark.parametrize("median", [0.02, 0.5, 80, 1000])
def test_plausible_metres_need_no_word(median: float) -> None:
    assert implausible(np.full(5, median), 256) is None


def test_nothing_known_needs_no_word() -> None:
    assert implausible(np.zeros(4)) is None


@pytest.mark.parametrize(
    ("median", "scale", "advice"),
    [
        (2000.0, 1.0, "--depth-scale 1000 (now 1) would make it 2.0 m"),
        (0.01, 100_000.0, "--depth-scale 1000 (now 100000) would make it 1.0 m"),
        (0.002, 1000.0, "--depth-scale 10 (now 1000) would make it 0.2 m"),
        (4e9, 1.0, "give codes per metre with --depth-scale (now 1)"),
    ],
)
def test_a_scale_that_would_be_plausible_is_proposed(
    median: float, scale: float, advice: str
) -> None:
    warning = implausible(np.full(3, median), scale)
    assert warning is not None
    assert advice in warning
    assert warning.startswith("median depth ")


def test_a_float_file_in_millimetres_is_an_error_that_names_metres() -> None:
    warning = implausible(np.full(3, 2500.0))
    assert warning == (
        "median depth 2,500.0 m is implausible, the scale is probably wrong: "
        "a float file must hold metres; divided by 1000 it would be 2.5 m"
    )


def test_real_millimetres_read_as_single_codes_are_noticed(shared_data: Path) -> None:
    path = shared_data / "icl_nuim" / "depth" / "00000.png"
    right, wrong = read_depth(path, scale=1000), read_depth(path, scale=1)
    assert implausible(right.values, right.scale) is None
    warning = implausible(wrong.values, wrong.scale)
    assert warning is not None
    assert "--depth-scale 1000 (now 1)" in warning


def test_a_map_that_may_be_a_room_in_millimetres_gets_a_note() -> None:
    kitchen = np.array([[800, 3400]]) / 256
    line = describe_range(kitchen, "16-bit PNG ÷ 256", assumed_scale=True)
    assert line == (
        "2 points, 3.1–13.3 m (16-bit PNG ÷ 256 assumed; if it holds millimetres, --depth-scale"
        " 1000 makes it 0.8–3.4 m)"
    )
    for source, assumed in (("16-bit PNG ÷ 256", False), ("16-bit PNG ÷ 1000", True)):
        assert "millimetres" not in describe_range(kitchen, source, assumed_scale=assumed)
