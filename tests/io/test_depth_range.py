"""The line about the range of a depth file, and the warning about a wrong scale."""

from __future__ import annotations

import numpy as np
import pytest

from pnpdepth_cli.io.depth import describe_range, implausible

PNG = "16-bit PNG ÷ 256"
OTHER = "if it holds millimetres, --depth-scale 1000 makes it 0.8–3.4 m"


@pytest.mark.parametrize(
    ("depth", "source", "assumed", "line"),
    [
        ([0, np.nan, 5.0], "PFM", False, "1 point, 5.0 m (PFM)"),
        ([0, 0], "PFM", False, "no points with known depth (PFM)"),
        ([0.4, 9.96], "x", False, "2 points, 0.4–10.0 m (x)"),
        ([0.034, 0.97], "x", False, "2 points, 0.034–1.0 m (x)"),
        ([12, 12345.6], "x", False, "2 points, 12.0–12,345.6 m (x)"),
        ([0.0001, 2], "x", False, "2 points, 1.0e-04–2.0 m (x)"),
        ([2, 63.4] * 500, PNG, True, f"1,000 points, 2.0–63.4 m ({PNG}; --depth-scale to change)"),
        ([3, 13], "PNG ÷ 1000", True, "2 points, 3.0–13.0 m (PNG ÷ 1000; --depth-scale to change)"),
        ([3.125, 13.28], PNG, False, f"2 points, 3.1–13.3 m ({PNG})"),
        ([3.125, 13.28], PNG, True, f"2 points, 3.1–13.3 m ({PNG} assumed; {OTHER})"),
    ],
)
def test_the_range_has_count_ends_and_what_was_assumed(
    depth: list[float], source: str, assumed: bool, line: str
) -> None:
    assert describe_range(np.array(depth), source, assumed_scale=assumed) == line


@pytest.mark.parametrize("median", [0, 0.02, 0.5, 80, 1000])
def test_plausible_metres_and_nothing_known_need_no_word(median: float) -> None:
    assert implausible(np.full(5, median), 256) is None


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
    warning = implausible(np.full(3, 1e9))
    assert warning is not None
    assert warning.endswith(": a float file must hold metres")
