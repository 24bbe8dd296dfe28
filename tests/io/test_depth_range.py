"""The line about the range of a depth file, and the warning about a wrong scale."""

from __future__ import annotations

import numpy as np
import pytest

from pnpdepth_cli.errors import InputError
from pnpdepth_cli.io.depth import describe_range, scale_warning
from pnpdepth_cli.io.formats import Reading

PNG = "16-bit PNG ÷ 256"


FLOAT = Reading("PFM", None, False)
BY_256, BY_1000 = (Reading("PNG", scale, False) for scale in (256.0, 1000.0))


def test_a_ratio_that_no_wrong_scale_gives_needs_no_word_and_an_assumed_one_is_an_error() -> None:
    for ratio in (np.nan, 0, 1, 2, 3.906 * 1.11, 3.906 / 1.11):
        assert scale_warning("depths", ratio, {"--scale": BY_256, "--gt-scale": BY_256}) is None
    kinds = {"--scale": FLOAT, "--gt-scale": BY_256._replace(assumed=True)}
    with pytest.raises(InputError):
        scale_warning("depths", 3.9, kinds)


@pytest.mark.parametrize(
    ("ratio", "depth", "truth", "advice"),
    [
        (4.2, BY_256, FLOAT, "--scale 1000 (now 256)"),
        (0.256, FLOAT, BY_256, "--gt-scale 1000 (now 256)"),
        (0.001, BY_1000, None, "--scale 1 (now 1000)"),
        (5, BY_256, BY_256, "--scale 1280 (now 256) or --gt-scale 51.2 (now 256)"),
        (3.9, FLOAT, FLOAT, "metres"),
    ],
)
def test_a_ratio_that_a_wrong_scale_explains_names_the_scale_that_removes_it(
    ratio: float, depth: Reading, truth: Reading | None, advice: str
) -> None:
    assert advice in str(scale_warning("depths", ratio, {"--scale": depth, "--gt-scale": truth}))


@pytest.mark.parametrize(
    ("depth", "line"),
    [
        ([0, np.nan, 5.0], "1 point, 5.0 m"),
        ([0, 0], "no points"),
        ([0.034, 0.97], "2 points, 0.034–1.0 m"),
        ([12, 12345.6], "2 points, 12.0–12,345.6 m"),
    ],
)
def test_the_range_has_count_and_ends(depth: list[float], line: str) -> None:
    assert describe_range(np.array(depth), FLOAT).startswith(line)


def test_a_scale_that_was_assumed_is_named_with_another_where_depths_look_wrong() -> None:
    assumed = BY_256._replace(source=PNG, assumed=True)
    assert "--depth-scale 1000" in describe_range(np.array([3.125, 13.28]), assumed)
