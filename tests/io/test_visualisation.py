"""Figures for people, panel by panel, and their colours."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from pnpdepth_cli.file_record import FigureRecord
from pnpdepth_cli.io.figure import UNKNOWN, depth_scale, resized
from pnpdepth_cli.io.visualisation import (
    improvement,
    preview,
)

BLUE, ORANGE = [25, 90, 190], [220, 105, 0]
TITLES = ["Image", "Sparse depth", "Depth before", "Depth after", "Change"]


def pixels_of(path: Path) -> np.ndarray:
    with Image.open(path) as image:
        image.load()
        return np.asarray(image)


def panels_of(path: Path, content: FigureRecord) -> dict[str, np.ndarray]:
    """The panels of a figure by title."""
    pixels, boxes = pixels_of(path), content.panels
    return {title: pixels[y : y + h, x : x + w] for title, (x, y, w, h) in boxes.items()}


def scene(height: int, width: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """rgb, depth 2..8 m, and xy of nine pixels."""
    rng = np.random.default_rng(0)
    rgb = rng.random((height, width, 3), dtype=np.float32)
    depth = np.linspace(2, 8, height * width, dtype=np.float32).reshape(height, width)
    xy = np.stack([rng.integers(0, width, 9), rng.integers(0, height, 9)], axis=1)
    return rgb, depth, xy.astype(np.float32)


def at(depth: np.ndarray, xy: np.ndarray) -> np.ndarray:
    columns, rows = xy.astype(int).T
    return depth[rows, columns]


def previewed(folder: Path, before: np.ndarray, after: np.ndarray) -> dict[str, np.ndarray]:
    """The panels of a preview without image and points."""
    none, path = np.zeros(0, np.float32), folder / "p.png"
    return panels_of(path, preview(None, none.reshape(0, 2), none, before, after, path))


@pytest.mark.parametrize(
    ("height", "width", "columns"), [(60, 80, 2), (37, 124, 1), (10, 1700, 1), (1, 1, 2)]
)
def test_a_preview_has_its_panels_in_columns_and_depth_in_the_colours_of_one_scale(
    tmp_path: Path, height: int, width: int, columns: int
) -> None:
    rgb, depth, xy = scene(height, width)
    path, before = tmp_path / "p.png", depth * 1.2
    content = preview(rgb, xy, at(depth, xy), before, depth, path)
    panels, page = panels_of(path, content), pixels_of(path)
    scale = depth_scale(at(depth, xy), before, depth)
    assert page.shape[1] <= 1600
    assert content.size == page.shape[1::-1]
    assert content.scale_m == (scale.low_m, scale.high_m)
    assert list(panels) == TITLES
    assert len({left for left, *_ in content.panels.values()}) == columns
    shown = panels["Depth before"]
    if factor := shown.shape[1] // width:
        centres = shown[factor // 2 :: factor, factor // 2 :: factor]
        assert np.array_equal(centres, scale.paint(before))
    again = path.read_bytes()
    preview(rgb, xy, at(depth, xy), before, depth, path)
    assert path.read_bytes() == again


def test_depths_that_are_unknown_or_all_alike_still_make_a_preview(tmp_path: Path) -> None:
    none, one = np.zeros((6, 8), np.float32), np.full((6, 8), 3, np.float32)
    nan = np.full((6, 8), np.nan, np.float32)
    pairs = [(none, none), (one, one), (nan, one), (none, one), (one, none), (one, one * np.inf)]
    for before, after in [*pairs, (one * 1e-4, one * 1e6)]:
        panels = previewed(tmp_path, before, after)
        known, known_after = ((np.isfinite(depth) & (depth > 0)).any() for depth in (before, after))
        assert (panels["Depth before"] == UNKNOWN).all() == (not known)
        # where one is unknown nothing has changed, and the map is dark
        assert (panels["Change"][-9:, -9:] > 100).any() == (known and known_after)


def improved(
    folder: Path, gt: list, before: list, after: list, **options: Any
) -> tuple[float, Any, FigureRecord]:
    """What `improvement` returns for one row, with a colour per pixel in between."""
    rows = (np.array([row], np.float32) for row in (before, after, gt))
    size = 1, len(gt)
    maps = (row.reshape(size) for row in rows)
    share, content = improvement(*maps, folder / "i.png", image=None, size=size, **options)
    shown = panels_of(folder / "i.png", content)["Change of error"]
    factor = shown.shape[1] // len(gt)
    return share, shown[factor // 2, factor // 2 :: factor].tolist(), content


def test_better_worse_equal_and_unknown_have_their_own_colours(tmp_path: Path) -> None:
    # |6 - 5| = |4 - 5|: unchanged
    share, colours, content = improved(tmp_path, [5, 5, 5, 0], [6, 5, 6, 6], [5, 6, 4, 5])
    assert share == 1 / 3
    assert colours[:2] == [BLUE, ORANGE]
    assert len(set(colours[2])) == len(set(colours[3])) == 1
    assert colours[3][0] < 80 < 150 < colours[2][0]
    assert content.ends == ("worse by 1 m or more", "better by 1 m or more")
    assert content.footer == "33.3 % of 3 pixels improved, 33.3 % worse"
    assert content.unknown == "no ground truth"
    assert improved(tmp_path, [5, 5], [6, 5], [5, 6])[2].unknown is None
    # the change itself has other colours: teal is farther
    change = previewed(tmp_path, np.full((8, 12), 4, np.float32), np.full((8, 12), 5, np.float32))
    assert change["Change"][0, 0].tolist() == [1, 102, 94]


@pytest.mark.parametrize(("held_out", "grey"), [(True, False), (False, True)])
def test_points_are_coloured_discs_where_they_lie(
    tmp_path: Path, held_out: bool, grey: bool
) -> None:
    image, path = None if grey else np.full((30, 40, 3), 0.5, np.float32), tmp_path / "i.png"
    xy, truth = np.array([[5, 5], [30, 20]], np.float32), np.array([2, 3], np.float32)
    before, after = (truth + np.array(error, np.float32) for error in ([1, 0], [0, 1]))
    share, content = improvement(
        before, after, truth, path, image=image, size=(30, 40), xy=xy, held_out=held_out
    )
    assert share == 0.5
    panel = panels_of(path, content)["Change of error"]
    factor = panel.shape[1] // 40
    colours = panel[factor // 2 :: factor, factor // 2 :: factor]
    assert (colours[5, 5].tolist(), colours[20, 30].tolist()) == (BLUE, ORANGE)
    assert len(set(colours[12, 17].tolist())) == 1
    assert ("held-out" in content.footer) == held_out


def test_a_reduced_image_has_means_and_an_enlarged_one_squares() -> None:
    pixels = np.array([[0, 2], [4, 6]], np.float32)
    assert resized(pixels, 0.5).tolist() == [[3]]
    assert resized(pixels, 2).tolist() == pixels.repeat(2, 0).repeat(2, 1).tolist()
