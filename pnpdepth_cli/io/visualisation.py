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

Pixels = NDArray[np.uint8]
Array = NDArray[np.float32]
Panel = tuple[str, str, Pixels]
"""Title, a fainter remark beside it, and an image (H, W, 3)."""

UNKNOWN = 70
"""The grey of a pixel without depth: turbo has no such colour."""

_SIGNED = {"gain": ((25, 90, 190), (220, 105, 0)), "change": ((1, 102, 94), (118, 42, 131))}
"""Colours of 1 and -1: better and worse, farther and nearer. Blue and orange are told apart by
colour-blind eyes."""

LOGARITHMIC_FROM = 8.0
"""Ratio of far to near from which the scale is logarithmic; on a linear one, nearly all of a street
would have the colour of its far end."""

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
_LABELS = 9  # of the bar
# Wider images than this (KITTI is 3.3 : 1) are stacked; two in a row would be too small.
_WIDE = 2.0
_STRONGEST_PERCENTILE = 95.0
_GAINS = "Change of error"
"""Title of the panel of gains, by which a report finds it."""
_FAST = 2  # zlib's level: a third of the time of its default 6, files a tenth larger


@dataclass(frozen=True, kw_only=True)
class DepthScale:
    """The colour of each depth: turbo from `low_m`, near and warm, to `high_m`, far and cold."""

    low_m: float
    high_m: float

    @property
    def logarithmic(self) -> bool:
        """True if the colours follow log depth."""
        return self.high_m / self.low_m > LOGARITHMIC_FROM

    def paint(self, depth: NDArray[np.floating]) -> Pixels:
        """Returns (..., 3) colours of depths of any shape; `UNKNOWN` where there is none."""
        known = np.isfinite(depth) & (depth > 0)
        depths = np.clip(np.where(known, depth, self.low_m), self.low_m, self.high_m, dtype=float)
        position = (depths - self.low_m) / (self.high_m - self.low_m)
        if self.logarithmic:
            position = np.log(depths / self.low_m) / math.log(self.high_m / self.low_m)
        # The last tenths of turbo are so dark at both ends that near and far look alike.
        levels = np.rint(12 + 231 * (1 - position)).astype(np.intp)
        table = cv2.applyColorMap(np.arange(256, dtype=np.uint8)[:, None], cv2.COLORMAP_TURBO)
        return np.where(known[..., None], table[:, 0, ::-1][levels], np.uint8(UNKNOWN))


def depth_scale(*depths: NDArray[np.floating]) -> DepthScale:
    """Returns the scale over the 2nd to 98th percentile of all known depths together."""
    known = np.concatenate([depth[np.isfinite(depth) & (depth > 0)] for depth in depths])
    if not known.size:
        return DepthScale(low_m=1.0, high_m=2.0)
    low, high = np.percentile(known.astype(np.float64), (2, 98)).tolist()
    if high - low < 0.01 * low:  # a single depth still needs a bar with two ends
        low = 0.95 * low
        high = 1.05 * high
    return DepthScale(low_m=low, high_m=high)


def _grey_of(rgb: Array | None, size: tuple[int, ...]) -> Array:
    """(H, W) luma in 0..1 of an (H, W, 3) image in 0..1; without one, a uniform grey."""
    if rgb is None:
        return np.full(size, 0.3, np.float32)
    weights = np.array([0.299, 0.587, 0.114], dtype=np.float32)
    return np.asarray(np.clip(np.nan_to_num(rgb), 0, 1) @ weights, dtype=np.float32)


def _dim(grey: Array) -> Pixels:
    """An (H, W, 3) dark grey image, on which coloured points stand out."""
    levels = np.rint(20 + 115 * grey).astype(np.uint8)
    return np.repeat(levels[:, :, None], 3, axis=2)


def _paint_signed(values: NDArray[np.floating], light: NDArray[np.floating], colors: str) -> Pixels:
    """(..., 3) colours of `_SIGNED` from -1 to 1, around the grey `light` 0..1 at 0."""
    above, below = np.array(_SIGNED[colors], np.float32)
    signed = values[..., None].astype(np.float32)
    amount = np.clip(np.abs(signed), 0, 1)
    base = 255 * light[..., None].astype(np.float32)
    hue = np.where(signed > 0, above, below)
    return np.asarray(np.rint((1 - amount) * base + amount * hue), np.uint8)


def signed_bar(colors: str, length: int) -> Pixels:
    """Returns (length, 3) colours of a legend of a signed map."""
    return _paint_signed(np.linspace(-1, 1, length), np.full(length, 0.88), colors)


def _magnification(shape: tuple[int, ...], *, columns: int = 1) -> float:
    """The factor by which an image (H, W, ...) fits its column, a whole number if it enlarges."""
    height, width = shape[:2]
    room = FIGURE_WIDTH - 2 * MARGIN - (columns - 1) * GAP - _LEGEND_WIDTH
    fit = min(room / columns / width, _MAX_PANEL_HEIGHT / height)
    return math.floor(fit) if fit >= 1 else fit


def _resize(pixels: Pixels, factor: float, *, smooth: bool = False) -> Pixels:
    """The image at `factor` times its size; enlarged pixels stay square unless `smooth`."""
    height, width = pixels.shape[:2]
    size = (max(1, round(width * factor)), max(1, round(height * factor)))
    enlarging = cv2.INTER_CUBIC if smooth else cv2.INTER_NEAREST
    method = cv2.INTER_AREA if factor < 1 else enlarging
    return np.asarray(cv2.resize(pixels, size, interpolation=method))


def _points_panel(grey: Array, xy: Array, depth: Array, scale: DepthScale, factor: float) -> Panel:
    """The points in the colours of their depth on the dark grey image, nearest on top."""
    nearest_last = np.argsort(-depth, kind="stable")
    canvas = _dots(grey, xy[nearest_last], scale.paint(depth[nearest_last]), factor)
    return "Sparse depth", f"{len(depth):,} point{'' if len(depth) == 1 else 's'}", canvas


def _dots(grey: Array, xy: Array, colours: Pixels, factor: float) -> Pixels:
    """The dark grey image with points in these colours, the last on top."""
    canvas = np.ascontiguousarray(_resize(_dim(grey), factor, smooth=True))
    spacing = math.sqrt(canvas.shape[0] * canvas.shape[1] / max(len(xy), 1))
    # OpenCV takes coordinates in sixteenths of a pixel.
    radius = round(16 * min(max(0.24 * spacing, 1.4), 6.0))
    centres = np.rint(16 * ((xy.astype(np.float64) + 0.5) * factor - 0.5)).astype(int).tolist()
    for centre, colour in zip(centres, colours.tolist(), strict=True):
        cv2.circle(canvas, centre, radius, colour, -1, cv2.LINE_AA, 4)
    return canvas


def _save_depth_figure(
    path: Path, panels: list[Panel], scale: DepthScale, unit: str = "m", *, columns: int = 1
) -> FigureRecord:
    """Writes a PNG of panels beside a bar of depth colours."""
    space = np.geomspace if scale.logarithmic else np.linspace
    bar, marks = (space(scale.low_m, scale.high_m, count) for count in (256, _LABELS))
    labels = [f"{depth:.3g}" for depth in marks]
    noun = "metres" if unit == "m" else unit
    figure = _save_figure(path, panels, scale.paint(bar), labels, noun, columns)
    return replace(figure, scale_m=(scale.low_m, scale.high_m))


def _save_figure(
    path: Path, panels: list[Panel], bar: Pixels, labels: Sequence[str], noun: str, columns: int = 1
) -> FigureRecord:
    """Writes panels of one size, `columns` to a row; a bar (N, 3) and labels from the lower end."""
    from PIL import Image, ImageDraw, ImageFont

    height, width = panels[0][2].shape[:2]
    rows = math.ceil(len(panels) / columns)
    row_height = _TITLE_HEIGHT + height
    width_px = 2 * MARGIN + columns * width + (columns - 1) * GAP + _LEGEND_WIDTH
    height_px = 2 * MARGIN + rows * row_height + (rows - 1) * (GAP // 2)
    figure = Image.new("RGB", (width_px, height_px), "white")
    draw = ImageDraw.Draw(figure)
    # Pillow's own font: the same everywhere. It has no en dash, minus or multiplication sign.
    font, small = (ImageFont.load_default(size) for size in (_FONT_SIZE, _SMALL_FONT_SIZE))
    # The panels, and where they are.
    boxes = {}
    for index, (title, remark, pixels) in enumerate(panels):
        row, column = divmod(index, columns)
        x = MARGIN + column * (width + GAP)
        y = MARGIN + row * (row_height + GAP // 2)
        draw.text((x, y + 4), title, font=font, fill=_INK)
        indent = draw.textlength(title, font=font) + 14
        draw.text((x + indent, y + 5), remark, font=small, fill=_FAINT_INK)
        figure.paste(Image.fromarray(np.ascontiguousarray(pixels)), (x, y + _TITLE_HEIGHT))
        boxes[title] = (x, y + _TITLE_HEIGHT, width, height)
    # The bar, far at the top, as on an axis.
    left = width_px - MARGIN - _LEGEND_WIDTH + GAP
    top = MARGIN + _TITLE_HEIGHT
    length = height_px - MARGIN - top
    draw.text((left, MARGIN + 5), noun, font=font, fill=_INK)
    strip = Image.fromarray(np.ascontiguousarray(bar[::-1, None])).resize((_BAR_WIDTH, length))
    figure.paste(strip, (left, top))
    ends = np.linspace(top + length - 1, top, len(labels)).tolist()
    for y, label in zip(ends, labels, strict=True):
        draw.line((left + _BAR_WIDTH, y, left + _BAR_WIDTH + 6, y), fill=_INK, width=1)
        draw.text((left + _BAR_WIDTH + 11, y), label, font=small, fill=_INK, anchor="lm")
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
        before: (H, W) before refinement.
        after: (H, W) after refinement.
        path: The PNG.
        unit: Name in the legend.
        made_by: Names of what made the depth before and the depth after.

    Raises:
        OutputError: The file cannot be written.
    """
    height, width = before.shape
    columns = 1 if width > _WIDE * height else 2
    factor = _magnification(before.shape, columns=columns)
    scale = depth_scale(sparse_depth, before, after)
    grey = _grey_of(rgb, before.shape)
    # The change, where both depths are known.
    both = (before > 0) & (after > 0) & np.isfinite(before) & np.isfinite(after)
    change = (after[both] - before[both]).astype(np.float64)
    pixels, strongest = _paint(change, both, grey, "change")
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
    """Writes a PNG with N points in the colours of their depth on the grey image, nearest on top.

    The image is (H, W, 3) in 0..1, the points are (N, 2) pixel coordinates and (N,) metres.
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
    """A map of signed values in colours on the dark grey image, and the value of full colour."""
    strongest = _strongest(values)
    pixels = _dim(np.asarray(0.6 * grey, np.float32))
    pixels[where] = _paint_signed(values / strongest, 0.66 + 0.3 * grey[where], colors)
    return pixels, strongest


def _strongest(values: NDArray[np.float64]) -> float:
    """The value of full colour: a high percentile of those that are not 0; 1 without any."""
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
        before: (H, W) before refinement.
        after: (H, W) after refinement.
        truth: (H, W) as measured, some of it known.
        path: The PNG.
        unit: Name of the unit of depth.

    Raises:
        OutputError: The file cannot be written.
    """
    # The map.
    gains = gain(before, after, truth)
    known = np.isfinite(gains)
    gains = gains[known]
    pixels, strongest = _paint(gains, known, _grey_of(rgb, truth.shape), "gain")
    pixels = _resize(pixels, _magnification(truth.shape))
    # The figure, and its texts for a report.
    improved = 100 * float((gains > 0).mean())
    worse = 100 * float((gains < 0).mean())
    footer = f"{improved:.1f} % of {gains.size:,} pixels improved, {worse:.1f} % worse"
    unknown = None
    if not known.all():
        unknown = "unknown" if (truth[~known] > 0).any() else "no ground truth"
    remark = f"{footer}; dark: {unknown}" if unknown else footer
    figure = _save_gains(path, [(_GAINS, remark, pixels)], strongest, unit)
    return replace(figure, unknown=unknown, footer=footer)


@dataclass(frozen=True, kw_only=True)
class PointErrors:
    """N points at which depths are compared with a measured one, which none of them has seen."""

    xy: Array  # (N, 2) pixel coordinates
    truth: Array  # (N,) as measured
    before: Array  # (N,) the network's depth, aligned with other points
    after: Array  # (N,) the result
    linear: Array  # (N,) linear interpolation of other points
    what: str
    """What they are, such as "validation points"."""


def improvement_at_points(
    rgb: Array | None, points: PointErrors, size: tuple[int, int], path: Path, unit: str = "m"
) -> FigureRecord:
    """Writes a PNG of the points at which |depth - truth| fell, blue, and rose, orange.

    Beside the result, linear interpolation is compared with the same depth before. A point where
    the depth that is shown is unknown is left out.

    Args:
        rgb: (H, W, 3) in 0..1, the ground of the figure; None for a network without image.
        points: The points.
        size: (H, W) of the image.
        path: The PNG.
        unit: Name of the unit of depth.

    Raises:
        OutputError: The file cannot be written.
    """
    columns = 1 if size[1] > _WIDE * size[0] else 2
    grey = _grey_of(rgb, size)
    factor = _magnification(size, columns=columns)
    shown = {_GAINS: points.after, "Linear interpolation": points.linear}
    gains = {name: gain(points.before, depth, points.truth) for name, depth in shown.items()}
    # One scale for both panels.
    strongest = _strongest(
        np.concatenate([values[np.isfinite(values)] for values in gains.values()])
    )
    panels = []
    remarks = {}
    for name, gains_at_points in gains.items():
        known = np.isfinite(gains_at_points)
        values = gains_at_points[known]
        # The points in their colours, the largest change on top.
        order = np.argsort(np.abs(values), kind="stable")
        colours = _paint_signed(values[order] / strongest, np.full(len(values), 0.8), "gain")
        dots = _dots(grey, points.xy[known][order], colours, factor)
        better = 100 * float((values > 0).mean()) if len(values) else 0.0
        worse = 100 * float((values < 0).mean()) if len(values) else 0.0
        remarks[name] = f"{better:.1f} % better, {worse:.1f} % worse"
        panels.append((name, remarks[name], dots))
    # That of the result says how many points there are.
    footer = f"at {np.isfinite(gains[_GAINS]).sum():,} {points.what}: {remarks[_GAINS]}"
    title, _, dots = panels[0]
    panels[0] = (title, footer, dots)
    return replace(_save_gains(path, panels, strongest, unit, columns), footer=footer)


def _save_gains(
    path: Path, panels: list[Panel], strongest: float, unit: str, columns: int = 1
) -> FigureRecord:
    """Writes a PNG of panels beside a bar of gains, whose ends have the value of full colour."""
    labels = [f"{share * strongest:+.3g}" for share in (-1, -0.5, 0, 0.5, 1)]
    bar = signed_bar("gain", 256)
    figure = _save_figure(path, panels, bar, labels, f"gain, {unit}", columns)
    amount = f"by {strongest:.3g} {unit} or more"
    return replace(figure, ends=(f"worse {amount}", f"better {amount}"))


def gain(before: Array, after: Array, truth: Array) -> NDArray[np.float64]:
    """Returns by how much |depth - truth| fell; NaN where the truth or the depth after is unknown.

    Infinite depth, and NaN before, count as an error of 1e9.
    """
    known = np.isfinite(truth) & (truth > 0) & (after > 0)
    errors = (np.abs(depth.astype(np.float64) - truth) for depth in (before, after))
    was, now = (np.nan_to_num(error, nan=1e9, posinf=1e9) for error in errors)
    return np.where(known, was - now, np.nan)
