"""The line about the range of a depth file, and the warning about a wrong scale."""

from __future__ import annotations

import numpy as np
import pytest

from pnpdepth_cli.errors import InputError
from pnpdepth_cli.io.depth import describe_range, scale_warning
from pnpdepth_cli.io.formats import Reading

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
    assert describe_range(np.array(depth), Reading(source, assumed=assumed)) == line


FLOAT = Reading("PFM", None, False)
BY_256, BY_1000 = (Reading("PNG", scale, False) for scale in (256.0, 1000.0))
OWN_256 = Reading("PNG ÷ 256 (from the file)", 256.0, False)


@pytest.mark.parametrize("ratio", [np.nan, 0, 1, 2, 3.906 * 1.11, 3.906 / 1.11])
def test_a_ratio_that_no_wrong_scale_gives_needs_no_word(ratio: float) -> None:
    assert scale_warning("depths", ratio, {"--scale": BY_256, "--gt-scale": BY_256}) is None


@pytest.mark.parametrize(
    ("ratio", "depth", "truth", "about", "advice"),
    [
        ("4.2", BY_256, FLOAT, "3.906", "--scale 1000 (now 256)"),
        ("0.256", FLOAT, BY_256, "1/3.906", "--gt-scale 1000 (now 256)"),
        ("0.001", BY_1000, None, "1/1000", "--scale 1 (now 1000)"),
        ("3.9", OWN_256, BY_1000, "3.906", "--gt-scale 256 (now 1000)"),
        ("5", OWN_256, OWN_256, "5", "--scale 1280 (now 256) or --gt-scale 51.2 (now 256)"),
        ("3.9", FLOAT, FLOAT, "3.906", ""),
    ],
)
def test_a_ratio_that_a_wrong_scale_explains_names_the_scale_that_removes_it(
    ratio: str, depth: Reading, truth: Reading | None, about: str, advice: str
) -> None:
    got = scale_warning("depths", float(ratio), {"--scale": depth, "--gt-scale": truth})
    assert got == (
        f"warning: depths are {ratio} times the ground truth (median), about {about}: a scale is"
        f" probably wrong; {f'{advice} would remove it' if advice else 'float files hold metres'}"
    )


def test_a_wrong_scale_that_was_assumed_is_an_error() -> None:
    kinds = {"--scale": FLOAT, "--gt-scale": BY_256._replace(assumed=True)}
    with pytest.raises(InputError, match=r"would remove it, --gt-scale 256 keeps it$"):
        scale_warning("depths", 3.9, kinds)
