from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pnpdepth_cli.choices import COLORS
from pnpdepth_cli.errors import FileFormatError, InputError
from pnpdepth_cli.io.colours import paint_gain
from pnpdepth_cli.io.page import open_page
from pnpdepth_cli.io.report_images import (
    error_colours,
    error_map,
    gain_colours,
    image_paths,
    save_images,
)
from pnpdepth_cli.io.visualisation import improvement, preview

ORANGE, BLUE = [220, 105, 0], [25, 90, 190]


def size_of(path: Path) -> tuple[int, int]:
    with Image.open(path) as image:
        assert image.format == "JPEG"
        return image.size


@pytest.mark.parametrize(
    ("height", "width", "view", "thumb"),
    [
        (480, 640, (640, 480), (160, 120)),
        (375, 1242, (960, 290), (160, 48)),
        (2000, 500, (240, 960), (40, 160)),
        (46, 62, (930, 690), (62, 46)),
        (1, 1, (960, 960), (1, 1)),
    ],
)
def test_views_and_thumbs_are_of_bounded_size(
    tmp_path: Path, height: int, width: int, view: tuple[int, int], thumb: tuple[int, int]
) -> None:
    pixels = np.zeros((height, width, 3), np.uint8)
    views = {"first": pixels, "second": pixels, "map": pixels}
    save_images(tmp_path, "k", views, thumb="first")
    assert sorted(tmp_path.iterdir()) == sorted(image_paths(tmp_path, "k", list(views)))
    assert size_of(tmp_path / "k_second.jpg") == view
    assert size_of(tmp_path / "k_thumb.jpg") == size_of(tmp_path / "k_map_thumb.jpg") == thumb


def test_the_error_map_has_different_colours_for_too_far_and_too_near() -> None:
    truth = np.full((1, 4), 2, np.float32)
    prediction = np.array([[3, 1, 2, 0]], np.float32)
    colours = error_map(prediction, truth, None)
    assert colours.strongest_m == 1
    assert colours.pixels[0, 0].tolist() == ORANGE
    assert colours.pixels[0, 1].tolist() == BLUE
    right, none = colours.pixels[0, 2], colours.pixels[0, 3]
    assert len(set(right.tolist())) == len(set(none.tolist())) == 1
    assert right[0] > 150 > 80 > none[0]


def test_an_error_map_without_any_error_is_grey() -> None:
    depth = np.ones((3, 4), np.float32)
    pixels = error_map(depth, depth, np.full((3, 4), 0.5, np.float32)).pixels
    assert (pixels == pixels[0, 0, 0]).all()


def test_the_legends_go_from_end_to_end() -> None:
    legends = [(error_colours(), [BLUE, ORANGE])]
    for name in COLORS:
        ends = [paint_gain(np.array(s), np.array(0.88), name).tolist() for s in (-1.0, 1.0)]
        legends.append((gain_colours(name), ends))
    for colours, ends in legends:
        assert all(len(colour) == 7 for colour in colours)
        for colour, end in zip((colours[0], colours[-1]), ends, strict=True):
            assert [int(colour[i : i + 2], 16) for i in (1, 3, 5)] == end


def test_a_saved_page_can_be_taken_apart_again(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    rgb = rng.random((480, 640, 3), dtype=np.float32)
    depth = np.linspace(2, 6, rgb[..., 0].size, dtype=np.float32).reshape(480, 640)
    xy = np.array([[5, 6]], np.float32)
    preview(rgb, xy, np.array([3], np.float32), depth, depth + 1, tmp_path / "p.png")
    page = open_page(tmp_path / "p.png")
    assert (page.content["low_m"], page.content["high_m"]) == pytest.approx((2, 7), abs=0.2)
    panels = page.panels()
    titles = ["Image", "Sparse depth", "Depth before", "Depth after", "Change", "Zoom"]
    assert list(panels) == titles
    assert np.array_equal(panels["Image"], np.rint(255 * rgb).astype(np.uint8))
    assert panels["Depth before"].shape == (480, 640, 3)
    improvement(depth, depth + 1, depth, tmp_path / "i.png")
    page = open_page(tmp_path / "i.png")
    assert page.content["ends"] == ["worse by 1 m or more", "better by 1 m or more"]
    assert page.content["footer"] == "0.0 % of 307,200 pixels improved, 100.0 % worse"
    assert page.content["unknown"] is None
    assert page.panels()["Change of error"].shape == (960, 1280, 3)


def test_what_is_no_such_page_is_an_input_error(tmp_path: Path) -> None:
    path = tmp_path / "p.png"
    with pytest.raises(InputError, match="cannot be read"):
        open_page(path)
    path.write_bytes(b"text")
    with pytest.raises(InputError, match="cannot be read"):
        open_page(path)
    Image.new("RGB", (4, 4)).save(path)
    with pytest.raises(FileFormatError, match="no page of this program"):
        open_page(path)


def test_a_page_that_is_cut_short_is_an_input_error(tmp_path: Path) -> None:
    depth = np.random.default_rng(0).uniform(1, 9, (60, 80)).astype(np.float32)
    xy = np.array([[5, 6]], np.float32)
    path = tmp_path / "p.png"
    preview(None, xy, np.array([3], np.float32), depth, depth, path)
    path.write_bytes(path.read_bytes()[:20_000])
    page = open_page(path)
    with pytest.raises(FileFormatError, match=r"p\.png"):
        page.panels()
