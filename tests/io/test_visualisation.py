"""Figures for people, panel by panel, and their colours."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pnpdepth_cli.file_record import FigureRecord
from pnpdepth_cli.io.colours import UNKNOWN, depth_scale
from pnpdepth_cli.io.visualisation import (
    PointErrors,
    improvement,
    improvement_at_points,
    preview,
)


def panels_of(path: Path, content: FigureRecord) -> dict[str, np.ndarray]:
    with Image.open(path) as image:
        pixels = np.asarray(image)
    assert content.size == pixels.shape[1::-1]
    return {title: pixels[y : y + h, x : x + w] for title, (x, y, w, h) in content.panels.items()}


@pytest.mark.parametrize(("height", "width", "columns"), [(60, 80, 2), (37, 124, 1), (10, 1700, 1)])
def test_a_preview_has_its_panels_in_columns_and_depth_in_the_colours_of_one_scale(
    tmp_path: Path, height: int, width: int, columns: int
) -> None:
    path = tmp_path / "p.png"
    rgb = np.random.default_rng(0).random((height, width, 3), np.float32)
    depth = np.linspace(2, 8, height * width, dtype=np.float32).reshape(height, width)
    before = depth * 1.2
    xy = np.float32([[3, 0], [7, 9], [20, 5]])
    sparse = depth[[0, 9, 5], [3, 7, 20]]
    content = preview(rgb, xy, sparse, before, depth, path)
    panels = panels_of(path, content)
    scale = depth_scale(sparse, before, depth)
    assert content.size[0] <= 1600
    assert content.scale_m == (scale.low_m, scale.high_m)
    assert list(panels) == ["Image", "Sparse depth", "Depth before", "Depth after", "Change"]
    assert len({left for left, *_ in content.panels.values()}) == columns
    shown = panels["Depth before"]
    if factor := shown.shape[1] // width:
        assert np.array_equal(shown[::factor, ::factor], scale.paint(before))


@pytest.mark.parametrize(
    ("least", "most", "low", "high"), [(2.0, 3.0, 2.02, 2.98), (2.0, 2.001, 1.9, 2.1)]
)
def test_the_scale_of_depth_spans_its_percentiles_and_at_least_a_tenth_of_it(
    least: float, most: float, low: float, high: float
) -> None:
    scale = depth_scale(np.linspace(least, most, 1001))
    assert (scale.low_m, scale.high_m) == pytest.approx((low, high), rel=1e-3)


def test_depths_that_are_unknown_or_all_alike_still_make_a_preview(tmp_path: Path) -> None:
    none = np.zeros((6, 8), np.float32)
    one = np.full((6, 8), 3, np.float32)
    no_points = np.zeros((0, 2), np.float32), np.zeros(0, np.float32)
    for before, after in [(none, none), (one * np.nan, one), (one, one * np.inf), (one, 2 * one)]:
        content = preview(None, *no_points, before, after, tmp_path / "p.png")
        panels = panels_of(tmp_path / "p.png", content)
        known, known_after = ((np.isfinite(depth) & (depth > 0)).any() for depth in (before, after))
        assert (panels["Depth before"] == UNKNOWN).all() == (not known)
        # where one is unknown nothing has changed, and the map is dark
        assert (panels["Change"][-9:, -9:] > 100).any() == (known and known_after)
    assert panels["Change"][0, 0].tolist() == [1, 102, 94]  # teal is farther


BLUE = [25, 90, 190]
ORANGE = [220, 105, 0]


@pytest.fixture
def improved(tmp_path: Path) -> tuple[np.ndarray, FigureRecord]:
    """The map of four pixels: better, worse, equal (|6 - 5| = |4 - 5|) and unknown."""
    maps = np.array([[[6, 5, 6, 6]], [[5, 6, 4, 5]], [[5, 5, 5, 0]]], np.float32)
    content = improvement(None, *maps, tmp_path / "i.png", "inches")
    return panels_of(tmp_path / "i.png", content)["Change of error"], content


def test_better_worse_equal_and_unknown_have_their_own_colours(
    improved: tuple[np.ndarray, FigureRecord],
) -> None:
    shown, _ = improved
    better, worse, equal, unknown = shown[0, :: shown.shape[1] // 4].tolist()
    assert (better, worse) == (BLUE, ORANGE)
    assert len(set(equal)) == len(set(unknown)) == 1  # greys
    assert unknown[0] < 80 < 150 < equal[0]


def test_the_ends_of_the_scale_have_the_unit_of_the_depth(
    improved: tuple[np.ndarray, FigureRecord],
) -> None:
    _, content = improved
    assert content.ends == ("worse by 1 inches or more", "better by 1 inches or more")


def test_shares_are_of_the_pixels_whose_depth_is_known(
    improved: tuple[np.ndarray, FigureRecord],
) -> None:
    _, content = improved
    assert content.footer == "33.3 % of 3 pixels improved, 33.3 % worse"
    assert content.unknown == "no ground truth"


POINTS = PointErrors(
    xy=np.float32([[2, 2], [12, 2], [2, 12], [12, 12]]),
    truth=np.float32([5, 5, 5, 5]),
    before=np.float32([6, 6, 6, 6]),
    after=np.float32([5, 7, 4, 0]),  # better, worse, equal, and unknown
    linear=np.float32([7, 5, 5, 5]),
    what="validation points",
)


def colours_at_points(panel: np.ndarray) -> list[list[int]]:
    factor = panel.shape[0] / 15
    places = ((POINTS.xy[:, ::-1] + 0.5) * factor).astype(int)
    colours: list[list[int]] = panel[tuple(places.T)].tolist()
    return colours


@pytest.fixture
def improved_points(tmp_path: Path) -> tuple[dict[str, np.ndarray], FigureRecord]:
    """The panels of four points in 15 × 15 pixels."""
    content = improvement_at_points(None, POINTS, (15, 15), tmp_path / "i.png", "inches")
    return panels_of(tmp_path / "i.png", content), content


def test_points_that_got_better_are_blue_and_worse_orange_and_equal_grey(
    improved_points: tuple[dict[str, np.ndarray], FigureRecord],
) -> None:
    panels, _ = improved_points
    better, worse, equal, unknown = colours_at_points(panels["Change of error"])
    assert (better, worse) == (BLUE, ORANGE)
    assert min(equal) > 150
    assert len(set(unknown)) == 1  # no point, but the dark image
    assert unknown[0] < 100


def test_the_change_by_linear_interpolation_is_beside_that_of_the_points(
    improved_points: tuple[dict[str, np.ndarray], FigureRecord],
) -> None:
    panels, _ = improved_points
    assert list(panels) == ["Change of error", "Linear interpolation"]
    linear = colours_at_points(panels["Linear interpolation"])
    assert linear == [ORANGE, BLUE, BLUE, BLUE]


def test_shares_are_of_the_points_whose_depth_is_known(
    improved_points: tuple[dict[str, np.ndarray], FigureRecord],
) -> None:
    _, content = improved_points
    assert content.footer == "at 3 validation points: 33.3 % better, 33.3 % worse"
    assert content.ends == ("worse by 1 inches or more", "better by 1 inches or more")
