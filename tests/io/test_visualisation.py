from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from pnpdepth_cli.errors import (
    FileFormatError,
    InputError,
    NoPointsError,
    OutputError,
    SizeError,
)
from pnpdepth_cli.io.colours import (
    UNKNOWN,
    DepthScale,
    depth_scale,
    paint_signed,
    round_steps,
)
from pnpdepth_cli.io.figure import draw_discs, figure_content, magnification
from pnpdepth_cli.io.visualisation import (
    error_map,
    improvement,
    improvement_at_points,
    preview,
    sigma_preview,
)

RED, GREEN = [214, 26, 30], [16, 140, 52]
BLUE, ORANGE = [25, 90, 190], [220, 105, 0]


def pixels_of(path: Path) -> np.ndarray:
    with Image.open(path) as image:
        image.load()
        return np.asarray(image)


def panels_of(path: Path) -> dict[str, np.ndarray]:
    """The panels of a figure by title, where it says that they are."""
    pixels = pixels_of(path)
    boxes = {panel["title"]: panel["box"] for panel in figure_content(path)["panels"]}
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


@pytest.mark.parametrize(
    ("height", "width"), [(480, 640), (375, 1242), (60, 80), (1200, 700), (1080, 1920), (1, 1)]
)
@pytest.mark.parametrize("has_image", [True, False])
def test_a_preview_is_one_png_of_bounded_width(
    tmp_path: Path, height: int, width: int, has_image: bool
) -> None:
    rgb, depth, xy = scene(height, width)
    path = tmp_path / "p.png"
    preview(rgb if has_image else None, xy, at(depth, xy), depth * 1.2, depth, path)
    shape = pixels_of(path).shape
    assert 300 < shape[1] <= 1600
    assert shape[2] == 3
    assert list(tmp_path.iterdir()) == [path]


def test_wide_images_are_stacked_and_others_are_two_by_two(tmp_path: Path) -> None:
    for height, width, columns in [(375, 1242, 1), (480, 640, 2)]:
        rgb, depth, xy = scene(height, width)
        preview(rgb, xy, at(depth, xy), depth, depth, tmp_path / "p.png")
        shape = pixels_of(tmp_path / "p.png").shape
        assert shape[1] // width == columns
        assert shape[0] // height == 6 // columns


def test_the_image_stands_in_the_preview_as_it_is(tmp_path: Path) -> None:
    rgb, depth, xy = scene(480, 640)
    preview(rgb, xy, at(depth, xy), depth, depth, tmp_path / "p.png")
    page = pixels_of(tmp_path / "p.png")
    expected = np.rint(rgb * 255).astype(np.uint8)
    assert np.array_equal(page[24 + 34 : 24 + 34 + 480, 24 : 24 + 640], expected)


def test_equal_depths_have_equal_panels_and_other_depths_other_ones(tmp_path: Path) -> None:
    rgb, depth, xy = scene(480, 640)
    sparse = at(depth, xy)

    def lower_panels(after: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        preview(rgb, xy, sparse, depth, after, tmp_path / "p.png")
        below = 24 + 480 + 10 + 34  # of the margin and the row of the change
        row = pixels_of(tmp_path / "p.png")[-(below + 480) : -below]
        return row[:, 24 : 24 + 640], row[:, 24 + 640 + 20 : 24 + 2 * 640 + 20]

    assert np.array_equal(*lower_panels(depth))
    assert not np.array_equal(*lower_panels(depth[::-1].copy()))


def test_the_same_input_gives_the_same_bytes(tmp_path: Path) -> None:
    rgb, depth, xy = scene(60, 80)
    for name in ("a.png", "b.png"):
        preview(rgb, xy, at(depth, xy), depth * 1.1, depth, tmp_path / name)
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


def test_depths_that_are_unknown_or_all_alike_still_make_a_preview(tmp_path: Path) -> None:
    none, one = np.zeros((6, 8), np.float32), np.full((6, 8), 3, np.float32)
    nan = np.full((6, 8), np.nan, np.float32)
    no_xy, no_depth = np.zeros((0, 2), np.float32), np.zeros(0, np.float32)
    for before, after in [(none, none), (one, one), (nan, one), (one * 1e-4, one * 1e6)]:
        preview(None, no_xy, no_depth, before, after, tmp_path / "p.png")
        assert pixels_of(tmp_path / "p.png").size


def test_parts_of_different_size_are_refused(tmp_path: Path) -> None:
    rgb, depth, xy = scene(6, 8)
    with pytest.raises(SizeError, match=r"depth and after differ in size \(8x6 and 6x8\)"):
        preview(rgb, xy, at(depth, xy), depth, depth.T, tmp_path / "p.png")
    with pytest.raises(SizeError, match="depth and image differ"):
        improvement(depth, depth, depth, tmp_path / "p.png", rgb=rgb[:3])
    with pytest.raises(SizeError, match="differ in number"):
        improvement_at_points(rgb, xy, at(depth, xy), depth[0, :3], depth[0, :3], True, tmp_path)


def test_a_place_that_cannot_be_written_is_an_output_error(tmp_path: Path) -> None:
    rgb, depth, xy = scene(6, 8)
    (tmp_path / "f").write_text("a file, not a folder")
    with pytest.raises(OutputError):
        preview(rgb, xy, at(depth, xy), depth, depth, tmp_path / "f" / "p.png")


def panel(path: Path, height: int, width: int, factor: int) -> np.ndarray:
    """One colour per pixel of the original, from the panel of an improvement image."""
    page = pixels_of(path)[58 : 58 + height * factor, 24 : 24 + width * factor]
    return page[factor // 2 :: factor, factor // 2 :: factor]


def test_blue_is_better_orange_is_worse_and_equal_is_neither(tmp_path: Path) -> None:
    gt = np.array([[5, 5, 5, 0]], dtype=np.float32)
    before = np.array([[6, 5, 6, 6]], dtype=np.float32)
    after = np.array([[5, 6, 4, 5]], dtype=np.float32)  # |6 - 5| = |4 - 5|: unchanged
    share = improvement(before, after, gt, tmp_path / "i.png")
    assert share == 1 / 3
    factor = int(magnification(gt.shape, columns=1, legend=False))
    colours = panel(tmp_path / "i.png", 1, 4, factor)[0]
    assert colours[0].tolist() == BLUE
    assert colours[1].tolist() == ORANGE
    assert np.ptp(colours[2].astype(int)) == 0
    assert np.ptp(colours[3].astype(int)) == 0
    assert colours[3, 0] < 80 < 150 < colours[2, 0]


def test_the_papers_colours_are_red_and_green(tmp_path: Path) -> None:
    gt = np.array([[5, 5]], dtype=np.float32)
    before, after = np.array([[6, 5]], np.float32), np.array([[5, 6]], np.float32)
    improvement(before, after, gt, tmp_path / "i.png", colors="paper")
    factor = int(magnification(gt.shape, columns=1, legend=False))
    assert panel(tmp_path / "i.png", 1, 2, factor)[0].tolist() == [RED, GREEN]


def test_the_preview_shows_the_signed_change_and_zooms_to_it(tmp_path: Path) -> None:
    before = np.full((80, 120), 4, np.float32)
    after = before.copy()
    after[60:70, 90:100] = 5
    no_xy, no_depth = np.zeros((0, 2), np.float32), np.zeros(0, np.float32)
    preview(None, no_xy, no_depth, before, after, tmp_path / "p.png")
    panels = panels_of(tmp_path / "p.png")
    assert list(panels)[4:] == ["Change", "Zoom"]
    change, zoom = panels["Change"], panels["Zoom"]
    factor = change.shape[0] // 80
    farther, unchanged = change[65 * factor, 95 * factor], change[10 * factor, 10 * factor]
    assert farther.tolist() == [1, 102, 94]
    assert np.ptp(unchanged.astype(int)) == 0
    half = zoom.shape[1] // 2
    assert len(np.unique(zoom[:, : half - 2].reshape(-1, 3), axis=0)) == 1
    assert len(np.unique(zoom[:, half + 2 :].reshape(-1, 3), axis=0)) == 2


def test_the_zoom_shows_where_the_result_differs_most_from_linear_too(tmp_path: Path) -> None:
    before, linear = np.full((80, 120), 4, np.float32), np.full((80, 120), 4, np.float32)
    after = before.copy()
    after[60:70, 90:100] = 4.5  # network and linear agree, and the result is another
    linear[5:15, 10:20] = 4.4
    no_xy, no_depth = np.zeros((0, 2), np.float32), np.zeros(0, np.float32)

    def colours(**others: np.ndarray) -> list[int]:
        preview(None, no_xy, no_depth, before, after, tmp_path / "p.png", **others)
        zoom = panels_of(tmp_path / "p.png")["Zoom"]
        parts = np.array_split(zoom, 2 + len(others), axis=1)
        return [len(np.unique(part[:, 3:-3].reshape(-1, 3), axis=0)) for part in parts]

    assert colours() == [1, 2]
    assert colours(linear=linear) == [1, 1, 2]
    after[:] = before
    assert colours(linear=linear) == [1, 2, 1]


def test_depth_that_is_not_valid_is_hatched(tmp_path: Path) -> None:
    rgb, depth, xy = scene(60, 80)
    valid = np.ones((60, 80), bool)
    valid[:20] = False
    preview(rgb, xy, at(depth, xy), depth, depth, tmp_path / "p.png", valid=valid)
    panels = panels_of(tmp_path / "p.png")
    before, after = panels["Depth before"], panels["Depth after"]
    factor = before.shape[0] // 60
    assert np.array_equal(before[20 * factor :], after[20 * factor :])
    assert (after[: 20 * factor].astype(int) > before[: 20 * factor]).any(axis=2).all()
    sigma_preview(0.1 * depth, valid, tmp_path / "s.png")
    assert list(panels_of(tmp_path / "s.png")) == ["Standard deviation"]


def test_only_known_ground_truth_counts(tmp_path: Path) -> None:
    gt = np.array([[4, 0, np.nan, np.inf, -1]], dtype=np.float32)
    ones = np.ones_like(gt)
    assert improvement(6 * ones, 5 * ones, gt, tmp_path / "i.png") == 1
    assert improvement(6 * ones, 6 * ones, gt, tmp_path / "i.png") == 0
    with pytest.raises(InputError, match="no pixel with known depth"):
        improvement(ones, ones, 0 * ones, tmp_path / "none.png")
    assert not (tmp_path / "none.png").exists()


def test_a_depth_that_becomes_finite_is_an_improvement(tmp_path: Path) -> None:
    gt = np.array([[4, 4]], dtype=np.float32)
    before = np.array([[np.nan, np.nan]], dtype=np.float32)
    assert improvement(before, np.array([[5, np.nan]], np.float32), gt, tmp_path / "i.png") == 0.5


@pytest.mark.parametrize("held_out", [True, False])
@pytest.mark.parametrize("grey", [True, False])
def test_points_are_coloured_discs_where_they_lie(
    tmp_path: Path, held_out: bool, grey: bool
) -> None:
    rgb = np.full((30, 40, 3), 0.5, np.float32)
    xy = np.array([[5, 5], [30, 20]], dtype=np.float32)
    truth = np.array([2, 3], dtype=np.float32)
    share = improvement_at_points(
        rgb[:, :, 0] if grey else rgb,
        xy,
        truth,
        truth + np.array([1, 0], np.float32),
        truth + np.array([0, 1], np.float32),
        held_out,
        tmp_path / "i.png",
    )
    assert share == 0.5
    factor = int(magnification((30, 40), columns=1, legend=False))
    colours = panel(tmp_path / "i.png", 30, 40, factor)
    assert colours[5, 5].tolist() == BLUE
    assert colours[20, 30].tolist() == ORANGE
    assert np.ptp(colours[12, 17].astype(int)) == 0


def test_no_points_is_an_error(tmp_path: Path) -> None:
    none = np.zeros(0, np.float32)
    grey = np.zeros((4, 4), np.float32)
    with pytest.raises(NoPointsError):
        improvement_at_points(grey, none.reshape(0, 2), none, none, none, True, tmp_path / "i.png")


def test_points_outside_the_image_do_no_harm() -> None:
    xy = np.array([[-50, 3], [4, 400]], dtype=np.float32)
    ground = np.zeros((10, 10), np.float32)
    discs = draw_discs(ground, xy, np.full((2, 3), 255, np.uint8), 1.0, np.arange(2))
    assert (discs == 20).all()


@given(low=st.floats(0.001, 1e4), ratio=st.floats(1.02, 1e5))
def test_ticks_lie_within_the_scale_and_in_order(low: float, ratio: float) -> None:
    scale = DepthScale(low_m=low, high_m=low * ratio)
    ticks = scale.ticks()
    assert ticks == sorted(set(ticks))
    assert len(ticks) <= 16
    assert all(low * (1 - 1e-6) <= tick <= low * ratio * (1 + 1e-6) for tick in ticks)
    positions = scale.position(np.array([low, *ticks, low * ratio]))
    assert (np.diff(positions) >= 0).all()
    assert (positions[0], positions[-1]) == (0, pytest.approx(1))


def test_round_steps_are_round() -> None:
    assert round_steps(0.9, 3.1) == [1.0, 1.5, 2.0, 2.5, 3.0]
    assert round_steps(2, 63) == [10, 20, 30, 40, 50, 60]


def test_near_is_warm_far_is_cold_and_unknown_is_grey() -> None:
    scale = DepthScale(low_m=1, high_m=10)
    near, far, unknown, nan = scale.paint(np.array([1, 10, 0, np.nan])).astype(int)
    assert near[0] > near[2]
    assert far[2] > far[0]
    assert unknown.tolist() == nan.tolist() == [UNKNOWN] * 3


def test_a_few_wild_depths_do_not_stretch_the_scale() -> None:
    depth = np.linspace(1, 2, 1000)
    depth[:5] = 1e6
    assert depth_scale(depth).high_m < 2.1


def test_stronger_change_is_stronger_colour() -> None:
    colours = paint_signed(
        np.array([0, 0.3, 1, 7, -0.3, -1]), np.full(6, 0.9), "blue-orange"
    ).astype(int)
    assert colours[2].tolist() == colours[3].tolist() == BLUE
    assert colours[5].tolist() == ORANGE
    spread = np.ptp(colours, axis=1)
    assert spread[0] == 0 < spread[1] < spread[2]


def test_the_error_map_has_different_colours_for_too_far_and_too_near() -> None:
    truth = np.full((1, 4), 2, np.float32)
    prediction = np.array([[3, 1, 2, 0]], np.float32)
    pixels, strongest_m = error_map(prediction, truth, None)
    assert strongest_m == 1
    assert pixels[0, 0].tolist() == ORANGE
    assert pixels[0, 1].tolist() == BLUE
    right, none = pixels[0, 2], pixels[0, 3]
    assert len(set(right.tolist())) == len(set(none.tolist())) == 1
    assert right[0] > 150 > 80 > none[0]


def test_an_error_map_without_any_error_is_grey() -> None:
    depth = np.ones((3, 4), np.float32)
    pixels, _ = error_map(depth, depth, np.full((3, 4), 0.5, np.float32))
    assert (pixels == pixels[0, 0, 0]).all()


def test_a_figure_says_where_its_panels_are(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    rgb = rng.random((480, 640, 3), dtype=np.float32)
    depth = np.linspace(2, 6, rgb[..., 0].size, dtype=np.float32).reshape(480, 640)
    xy = np.array([[5, 6]], np.float32)
    path = tmp_path / "p.png"
    preview(rgb, xy, np.array([3], np.float32), depth, depth + 1, path)
    content, panels = figure_content(path), panels_of(path)
    assert (content["low_m"], content["high_m"]) == pytest.approx((2, 7), abs=0.2)
    assert content["size"] == pixels_of(path).shape[1::-1]
    titles = ["Image", "Sparse depth", "Depth before", "Depth after", "Change", "Zoom"]
    assert list(panels) == titles
    assert np.array_equal(panels["Image"], np.rint(255 * rgb).astype(np.uint8))
    assert panels["Depth before"].shape == (480, 640, 3)
    improvement(depth, depth + 1, depth, tmp_path / "i.png")
    content = figure_content(tmp_path / "i.png")
    assert content["ends"] == ["worse by 1 m or more", "better by 1 m or more"]
    assert content["footer"] == "0.0 % of 307,200 pixels improved, 100.0 % worse"
    assert content["unknown"] is None
    assert panels_of(tmp_path / "i.png")["Change of error"].shape == (960, 1280, 3)


def test_what_is_no_figure_is_an_input_error(tmp_path: Path) -> None:
    path = tmp_path / "p.png"
    with pytest.raises(InputError, match="cannot be read"):
        figure_content(path)
    path.write_bytes(b"text")
    with pytest.raises(InputError, match="cannot be read"):
        figure_content(path)
    Image.new("RGB", (4, 4)).save(path)
    with pytest.raises(FileFormatError, match="no figure of this program"):
        figure_content(path)
