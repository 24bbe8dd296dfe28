"""PNGs for people: inputs, depth before and after, its uncertainty, and where refinement helped."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.file_record import FigureRecord
from pnpdepth_cli.io.atomic import atomic_path
from pnpdepth_cli.io.colours import DepthScale, Pixels, depth_scale, paint_signed, signed_bar

Array = NDArray[np.float32]
Panel = tuple[str, str, Pixels]
"""Title, a fainter remark beside it, and an image (H, W, 3)."""

_LUMA_WEIGHTS = (0.299, 0.587, 0.114)  # of red, green and blue (ITU-R BT.601)
_UNIFORM_GREY = 0.3  # 0…1, of the ground without an image
_DIM_DARKEST = 20  # levels, of 0 to 255, of a dark image
_DIM_RANGE = 115
_MAP_DIM = 0.6  # of the light of that image, behind a map of signed values
_MAP_LIGHT = 0.66  # 0…1, of a value of 0 in a map where the image is black
_MAP_LIGHT_RANGE = 0.3  # that the image adds to it
_DOT_LIGHT = 0.8  # 0…1, of a point without a change

_DOT_SHIFT = 4  # bits of a coordinate below the whole pixel, as OpenCV draws points
_DOT_SPACING = 0.24  # radius of a point by the mean distance of points
_DOT_RADII_PX = (1.4, 6.0)  # the smallest and the largest
_BAR_COLOURS = 256
_NO_DEPTH_ERROR = 1e9  # metres, of a pixel whose depth before is unknown or infinite

# Pixels of a figure.
FIGURE_WIDTH = 1600
MARGIN = 24
GAP = 20
_TITLE_HEIGHT = 34
_MAX_PANEL_HEIGHT = 1100
_BAR_WIDTH = 22
_LEGEND_WIDTH = 112
_FONT_SIZE = 19
_SMALL_FONT_SIZE = 17
_INK = (32, 33, 36)
_FAINT_INK = (95, 99, 104)
_TITLE_TOP = 4  # of a title, below the top of its line
_REMARK_TOP = 5  # of a remark, which is smaller, and of the title of the bar
_REMARK_GAP = 14  # between a title and its remark
_MARK_LENGTH = 6  # of a mark beside the bar
_LABEL_GAP = 11  # between the bar and a label
_LABELS = 9  # number of labels of a bar of depth
# Wider images than this (KITTI is 3.3 : 1) are stacked; two in a row would be too small.
_WIDE = 2.0
_STRONGEST_PERCENTILE = 95.0
_GAINS = "Change of error"
"""Title of the panel of gains, by which a report finds it."""
_FAST = 2  # zlib's level: a third of the time of its default 6, files a tenth larger


def _grey_of(rgb: Array | None, size: tuple[int, ...]) -> Array:
    """The grey (H, W) of an image, 0…1; a uniform one without an image.

    Args:
        rgb: (H, W, 3) in 0..1, or None.
        size: (H, W) of the result without an image.
    """
    if rgb is None:
        return np.full(size, _UNIFORM_GREY, np.float32)
    weights = np.array(_LUMA_WEIGHTS, dtype=np.float32)
    return np.asarray(np.clip(np.nan_to_num(rgb), 0, 1) @ weights, dtype=np.float32)


def _dim(grey: Array) -> Pixels:
    """The dark image (H, W, 3) of grey (H, W) in 0…1, on which coloured points stand out."""
    levels = np.rint(_DIM_DARKEST + _DIM_RANGE * grey).astype(np.uint8)
    return np.repeat(levels[:, :, None], 3, axis=2)


def _magnification(shape: tuple[int, ...], *, columns: int = 1) -> float:
    """The factor at which an image fits its column of a figure, a whole number if it enlarges.

    Args:
        shape: Shape of the image, which begins with H and W.
        columns: Number of images in a row of the figure.
    """
    height, width = shape[:2]
    room = FIGURE_WIDTH - 2 * MARGIN - (columns - 1) * GAP - _LEGEND_WIDTH
    fit = min(room / columns / width, _MAX_PANEL_HEIGHT / height)
    return math.floor(fit) if fit >= 1 else fit


def _columns(size: tuple[int, ...]) -> int:
    """The number of panels in a row of a figure: wide images (H, W) are below each other."""
    height, width = size
    return 1 if width > _WIDE * height else 2


def _resize(pixels: Pixels, factor: float, *, smooth: bool = False) -> Pixels:
    """The image (H, W, 3) at `factor` times its size.

    A smaller one averages the pixels. In a larger one pixels become squares, or the image is
    interpolated if it is to be smooth.
    """
    height, width = pixels.shape[:2]
    size = (max(1, round(width * factor)), max(1, round(height * factor)))
    enlarging = cv2.INTER_CUBIC if smooth else cv2.INTER_NEAREST
    method = cv2.INTER_AREA if factor < 1 else enlarging
    return np.asarray(cv2.resize(pixels, size, interpolation=method))


def _points_panel(grey: Array, xy: Array, depth: Array, scale: DepthScale, factor: float) -> Panel:
    """The panel of points in the colours of their depth on a dark image, the nearest on top.

    Args:
        grey: (H, W) in 0…1, the image.
        xy: (N, 2) pixel coordinates of the points.
        depth: (N,) in the unit of the scale.
        scale: Colours of depths.
        factor: Size of the panel, times that of the image.
    """
    nearest_last = np.argsort(-depth, kind="stable")
    canvas = _dots(grey, xy[nearest_last], scale.paint(depth[nearest_last]), factor)
    return "Sparse depth", f"{len(depth):,} point{'' if len(depth) == 1 else 's'}", canvas


def _dots(grey: Array, xy: Array, colours: Pixels, factor: float) -> Pixels:
    """The dark image with a dot at each point, the last on top, (h, w, 3).

    Args:
        grey: (H, W) in 0…1, the image.
        xy: (N, 2) pixel coordinates of the points in it.
        colours: (N, 3) colours of the points.
        factor: Size of the result, times that of the image.
    """
    canvas = np.ascontiguousarray(_resize(_dim(grey), factor, smooth=True))
    # The fewer points there are, the larger are the dots.
    spacing_px = math.sqrt(canvas.shape[0] * canvas.shape[1] / max(len(xy), 1))
    smallest_px, largest_px = _DOT_RADII_PX
    radius_px = min(max(_DOT_SPACING * spacing_px, smallest_px), largest_px)
    # OpenCV takes coordinates in fractions of a pixel, as whole numbers.
    fractions = 1 << _DOT_SHIFT
    radius = round(fractions * radius_px)
    centres_px = (xy.astype(np.float64) + 0.5) * factor - 0.5
    centres = np.rint(fractions * centres_px).astype(int).tolist()
    for centre, colour in zip(centres, colours.tolist(), strict=True):
        cv2.circle(canvas, centre, radius, colour, cv2.FILLED, cv2.LINE_AA, _DOT_SHIFT)
    return canvas


def _save_depth_figure(
    path: Path, panels: list[Panel], scale: DepthScale, unit: str = "m", *, columns: int = 1
) -> FigureRecord:
    """Writes a PNG of panels beside a bar of the colours of depth.

    Args:
        path: The PNG.
        panels: Panels of one size.
        scale: Colours of depths.
        unit: Name of the unit of depth.
        columns: Number of panels in a row.
    """
    space = np.geomspace if scale.logarithmic else np.linspace
    bar = space(scale.low_m, scale.high_m, _BAR_COLOURS)
    labels = [f"{depth:.3g}" for depth in space(scale.low_m, scale.high_m, _LABELS)]
    noun = "metres" if unit == "m" else unit
    figure = _save_figure(path, panels, scale.paint(bar), labels, noun, columns)
    return replace(figure, scale_m=(scale.low_m, scale.high_m))


def _save_figure(
    path: Path, panels: list[Panel], bar: Pixels, labels: Sequence[str], noun: str, columns: int = 1
) -> FigureRecord:
    """Writes a PNG of panels beside a bar of colours, its legend.

    Args:
        path: The PNG.
        panels: Panels of one size.
        bar: (N, 3) colours of the bar, from its lower end.
        labels: Texts beside the bar at equal distances, from its lower end.
        noun: Title of the bar.
        columns: Number of panels in a row.

    Returns:
        Size of the figure, and where its panels are.
    """
    from PIL import Image, ImageDraw, ImageFont

    # The empty figure.
    height, width = panels[0][2].shape[:2]
    rows = math.ceil(len(panels) / columns)
    row_height = _TITLE_HEIGHT + height
    width_px = 2 * MARGIN + columns * width + (columns - 1) * GAP + _LEGEND_WIDTH
    height_px = 2 * MARGIN + rows * row_height + (rows - 1) * (GAP // 2)
    figure = Image.new("RGB", (width_px, height_px), "white")
    draw = ImageDraw.Draw(figure)
    # Pillow's own font: the same everywhere. It has no en dash, minus or multiplication sign.
    font, small = (ImageFont.load_default(size) for size in (_FONT_SIZE, _SMALL_FONT_SIZE))
    # The panels, each below its title and its remark, and where they are.
    boxes = {}
    for index, (title, remark, pixels) in enumerate(panels):
        row, column = divmod(index, columns)
        x = MARGIN + column * (width + GAP)
        y = MARGIN + row * (row_height + GAP // 2)
        draw.text((x, y + _TITLE_TOP), title, font=font, fill=_INK)
        indent = draw.textlength(title, font=font) + _REMARK_GAP
        draw.text((x + indent, y + _REMARK_TOP), remark, font=small, fill=_FAINT_INK)
        figure.paste(Image.fromarray(np.ascontiguousarray(pixels)), (x, y + _TITLE_HEIGHT))
        boxes[title] = (x, y + _TITLE_HEIGHT, width, height)
    # The bar, with its upper end at the top, as on an axis, and a mark at each label.
    left = width_px - MARGIN - _LEGEND_WIDTH + GAP
    top = MARGIN + _TITLE_HEIGHT
    length = height_px - MARGIN - top
    draw.text((left, MARGIN + _REMARK_TOP), noun, font=font, fill=_INK)
    strip = Image.fromarray(np.ascontiguousarray(bar[::-1, None])).resize((_BAR_WIDTH, length))
    figure.paste(strip, (left, top))
    ends = np.linspace(top + length - 1, top, len(labels)).tolist()
    for y, label in zip(ends, labels, strict=True):
        right = left + _BAR_WIDTH
        draw.line((right, y, right + _MARK_LENGTH, y), fill=_INK, width=1)
        draw.text((right + _LABEL_GAP, y), label, font=small, fill=_INK, anchor="lm")
    # The file.
    with atomic_path(path) as temporary:
        figure.save(temporary, "PNG", compress_level=_FAST)
    return FigureRecord(size=figure.size, panels=boxes)


def preview(
    rgb: Array | None,
    sparse_xy: Array,
    sparse_depth: Array,
    before: Array,
    after: Array,
    path: Path,
    unit: str = "m",
    made_by: tuple[str, str] = ("", ""),
) -> FigureRecord:
    """Writes a PNG of image, sparse depth, depth before and after, and the signed change.

    All depth panels have one colour scale.

    Args:
        rgb: (H, W, 3) in 0..1; None for a network without image.
        sparse_xy: (N, 2) pixel coordinates.
        sparse_depth: (N,) in `unit`, as all depths.
        before: (H, W) before refinement, 0 or not finite where unknown.
        after: (H, W) after refinement, likewise.
        path: The PNG.
        unit: Name of the unit of depth in the legend.
        made_by: Names of what made the depth before and the depth after.

    Raises:
        OutputError: The file cannot be written.
    """
    columns = _columns(before.shape)
    factor = _magnification(before.shape, columns=columns)
    scale = depth_scale(sparse_depth, before, after)
    grey = _grey_of(rgb, before.shape)
    # The change, where both depths are known.
    both_known = (before > 0) & (after > 0) & np.isfinite(before) & np.isfinite(after)
    change = (after[both_known] - before[both_known]).astype(np.float64)
    pixels, strongest = _paint(change, both_known, grey, "change")
    remark = f"after - before: teal farther, purple nearer, full at {strongest:.3g} {unit}"
    # The panels, the image first.
    panels = [
        _points_panel(grey, sparse_xy, sparse_depth, scale, factor),
        ("Depth before", made_by[0], _resize(scale.paint(before), factor)),
        ("Depth after", made_by[1], _resize(scale.paint(after), factor)),
        ("Change", remark, _resize(pixels, factor)),
    ]
    if rgb is not None:
        image = np.rint(255 * np.clip(np.nan_to_num(rgb), 0, 1)).astype(np.uint8)
        panels.insert(0, ("Image", "", _resize(image, factor, smooth=True)))
    return _save_depth_figure(path, panels, scale, unit, columns=columns)


def overlay(rgb: Array, xy: Array, depth: Array, path: Path) -> None:
    """Writes a PNG of points in the colours of their depth on a dark image, the nearest on top.

    Args:
        rgb: (H, W, 3) in 0..1.
        xy: (N, 2) pixel coordinates of the points.
        depth: (N,) metres.
        path: The PNG.

    Raises:
        OutputError: The file cannot be written.
    """
    scale = depth_scale(depth)
    grey = _grey_of(rgb, rgb.shape)
    panel = _points_panel(grey, xy, depth, scale, _magnification(rgb.shape))
    _save_depth_figure(path, [panel], scale)


def write_mask(path: Path, mask: NDArray[np.bool_]) -> None:
    """Writes an 8-bit PNG, 255 where the mask (H, W) is true and 0 elsewhere."""
    from PIL import Image

    with atomic_path(path) as temporary:
        Image.fromarray(np.where(mask, np.uint8(255), np.uint8(0))).save(temporary, "PNG")


def _paint(
    values: NDArray[np.float64], where: NDArray[np.bool_], grey: Array, colors: str
) -> tuple[Pixels, float]:
    """A map (H, W, 3) of signed values on a dark image, and the value that has the full colour.

    Args:
        values: (N,) signed values.
        where: (H, W) true at the N pixels of the values.
        grey: (H, W) in 0…1, the image.
        colors: Name of the two colours in `colours.SIGNED`.
    """
    strongest = _strongest(values)
    pixels = _dim(np.asarray(_MAP_DIM * grey, np.float32))
    light = _MAP_LIGHT + _MAP_LIGHT_RANGE * grey[where]
    pixels[where] = paint_signed(values / strongest, light, colors)
    return pixels, strongest


def _strongest(values: NDArray[np.float64]) -> float:
    """The amount of a signed value from which on it has the full colour.

    It is the 95th percentile of the amounts that are not 0; 1 if there are none.
    """
    changed = np.abs(values[values != 0])
    return float(np.percentile(changed, _STRONGEST_PERCENTILE)) if changed.size else 1.0


def improvement(
    rgb: Array | None, before: Array, after: Array, truth: Array, path: Path, unit: str = "m"
) -> FigureRecord:
    """Writes a PNG of where |depth - truth| fell and rose, as figure 4(d) of the paper.

    Equal errors are neither better nor worse. A pixel is dark where the truth or the refined depth
    is unknown.

    Args:
        rgb: (H, W, 3) in 0..1, the ground of the map; None for a network without image.
        before: (H, W) before refinement, 0 or not finite where unknown.
        after: (H, W) after refinement, likewise.
        truth: (H, W) as measured, likewise; the gain is known at one pixel at least.
        path: The PNG.
        unit: Name of the unit of depth.

    Raises:
        OutputError: The file cannot be written.
    """
    # The map.
    all_gains = gain(before, after, truth)
    is_known = np.isfinite(all_gains)
    gains = all_gains[is_known]
    pixels, strongest = _paint(gains, is_known, _grey_of(rgb, truth.shape), "gain")
    pixels = _resize(pixels, _magnification(truth.shape))
    # The texts for a report: how many pixels improved, and why others are dark.
    improved = 100 * float((gains > 0).mean())
    worse = 100 * float((gains < 0).mean())
    footer = f"{improved:.1f} % of {gains.size:,} pixels improved, {worse:.1f} % worse"
    unknown = None
    if not is_known.all():
        unknown = "unknown" if (truth[~is_known] > 0).any() else "no ground truth"
    remark = f"{footer}; dark: {unknown}" if unknown else footer
    # The figure.
    figure = _save_gains(path, [(_GAINS, remark, pixels)], strongest, unit)
    return replace(figure, unknown=unknown, footer=footer)


@dataclass(frozen=True, kw_only=True)
class PointErrors:
    """N points at which depths are compared with a measured one, which none of them has used."""

    xy: Array  # (N, 2) pixel coordinates
    truth: Array  # (N,) as measured
    before: Array  # (N,) the network's depth, aligned with other points
    after: Array  # (N,) the result
    linear: Array  # (N,) linear interpolation of other points
    what: str
    """Name of the points in texts, such as "validation points"."""


def improvement_at_points(
    rgb: Array | None, points: PointErrors, size: tuple[int, int], path: Path, unit: str = "m"
) -> FigureRecord:
    """Writes a PNG of the points at which |depth - truth| fell, blue, and rose, orange.

    One panel compares the result with the depth before, the other linear interpolation of other
    points with the same depth before. A panel leaves out the points where its depth is unknown.

    Args:
        rgb: (H, W, 3) in 0..1, the ground of the figure; None for a network without image.
        points: Points, and the depths at them.
        size: (H, W) of the image.
        path: The PNG.
        unit: Name of the unit of depth.

    Raises:
        OutputError: The file cannot be written.
    """
    columns = _columns(size)
    grey = _grey_of(rgb, size)
    factor = _magnification(size, columns=columns)
    # The gains of what each panel shows, by the panel's title.
    depths = {_GAINS: points.after, "Linear interpolation": points.linear}
    gains = {title: gain(points.before, depth, points.truth) for title, depth in depths.items()}
    # One scale for both panels.
    strongest = _strongest(
        np.concatenate([values[np.isfinite(values)] for values in gains.values()])
    )
    panels = []
    remarks = {}
    for title, gains_at_points in gains.items():
        is_known = np.isfinite(gains_at_points)
        values = gains_at_points[is_known]
        # The points in their colours, the largest change on top.
        order = np.argsort(np.abs(values), kind="stable")
        light = np.full(len(values), _DOT_LIGHT)
        colours = paint_signed(values[order] / strongest, light, "gain")
        dots = _dots(grey, points.xy[is_known][order], colours, factor)
        better = 100 * float((values > 0).mean()) if len(values) else 0.0
        worse = 100 * float((values < 0).mean()) if len(values) else 0.0
        remarks[title] = f"{better:.1f} % better, {worse:.1f} % worse"
        panels.append((title, remarks[title], dots))
    # The panel of the result, the first one, says how many points it has, and so does the report.
    footer = f"at {np.isfinite(gains[_GAINS]).sum():,} {points.what}: {remarks[_GAINS]}"
    title, _, dots = panels[0]
    panels[0] = (title, footer, dots)
    return replace(_save_gains(path, panels, strongest, unit, columns), footer=footer)


def _save_gains(
    path: Path, panels: list[Panel], strongest: float, unit: str, columns: int = 1
) -> FigureRecord:
    """Writes a PNG of panels beside a bar of gains, the amounts by which errors fell.

    Args:
        path: The PNG.
        panels: Panels of one size.
        strongest: Gain in `unit` at the upper end of the bar, and less 0 at the lower end.
        unit: Name of the unit of depth.
        columns: Number of panels in a row.
    """
    labels = [f"{share * strongest:+.3g}" for share in (-1, -0.5, 0, 0.5, 1)]
    bar = signed_bar("gain", _BAR_COLOURS)
    figure = _save_figure(path, panels, bar, labels, f"gain, {unit}", columns)
    amount = f"by {strongest:.3g} {unit} or more"
    return replace(figure, ends=(f"worse {amount}", f"better {amount}"))


def gain(before: Array, after: Array, truth: Array) -> NDArray[np.float64]:
    """Returns by how much |depth - truth| fell, in float64; above 0 where depth is better.

    It is NaN where the truth or the depth after is unknown. Infinite depth, and NaN before, count
    as an error of 1e9.

    Args:
        before: Depth before, of any shape.
        after: Depth after, of the same shape, 0 or NaN where unknown.
        truth: Depth as measured, of the same shape, 0 or not finite where unknown.
    """
    is_known = np.isfinite(truth) & (truth > 0) & (after > 0)
    errors = (np.abs(depth.astype(np.float64) - truth) for depth in (before, after))
    error_before, error_after = (
        np.nan_to_num(error, nan=_NO_DEPTH_ERROR, posinf=_NO_DEPTH_ERROR) for error in errors
    )
    return np.where(is_known, error_before - error_after, np.nan)
