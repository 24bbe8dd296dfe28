"""Colours for depth and for change of error, and the white figures with titled panels of them."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.file_record import FigureRecord
from pnpdepth_cli.io.atomic import atomic_path

if TYPE_CHECKING:
    import PIL.Image
    import PIL.ImageDraw

Pixels = NDArray[np.uint8]

UNKNOWN = 70
"""The grey of a pixel without depth: turbo has no such colour."""

_SIGNED = {
    "gain": ((25, 90, 190), (220, 105, 0)),
    "change": ((1, 102, 94), (118, 42, 131)),
}
"""Colours of 1 and -1: better and worse, farther and nearer.

Blue and orange are told apart by colour-blind eyes."""

LOGARITHMIC_FROM = 8.0
"""Ratio of far to near from which the scale is logarithmic.

On a linear scale, nearly all of a street would have the colour of its far end.
"""

# Pixels of a figure.
FIGURE_WIDTH, MARGIN, GAP = 1600, 24, 20
_TITLE_HEIGHT, _MAX_PANEL_HEIGHT = 34, 1100
_BAR_WIDTH, _LEGEND_WIDTH = 22, 112
_GAIN_LEGEND = (900, 84)  # width its text needs, height
_FONT_SIZE, _SMALL_FONT_SIZE = 19, 17
_INK = (32, 33, 36)
_FAINT_INK = (95, 99, 104)
_LINE = (200, 202, 206)
_UNKNOWN_GAIN = (52, 52, 52)
_FAST = 2  # zlib's level: a third of the time of its default 6, files a tenth larger


@dataclass(frozen=True, kw_only=True)
class DepthScale:
    """The colour of each depth: turbo from `low_m`, near and warm, to `high_m`, far and cold."""

    low_m: float
    high_m: float
    warm_is_far: bool = False  # whether the warm end is the far one, as for a standard deviation

    @property
    def logarithmic(self) -> bool:
        """True if the colours follow log depth."""
        return self.high_m / self.low_m > LOGARITHMIC_FROM

    def position(self, depth: NDArray[np.floating]) -> NDArray[np.float64]:
        """Returns 0 at the near end to 1 at the far end, clipped, for depths of any shape."""
        bounded = np.clip(np.asarray(depth, dtype=np.float64), self.low_m, self.high_m)
        if self.logarithmic:
            return np.log(bounded / self.low_m) / math.log(self.high_m / self.low_m)
        return (bounded - self.low_m) / (self.high_m - self.low_m)

    def paint(self, depth: NDArray[np.floating]) -> Pixels:
        """Returns (..., 3) colours of depths of any shape; `UNKNOWN` where there is none."""
        known = np.isfinite(depth) & (depth > 0)
        position = self.position(np.where(known, depth, self.low_m))
        pixels = _turbo(position if self.warm_is_far else 1 - position)
        pixels[~known] = UNKNOWN
        return pixels

    def ticks(self) -> list[float]:
        """Returns round depths within the range, ascending."""
        if not self.logarithmic:
            return round_steps(self.low_m, self.high_m)
        decades = range(math.floor(math.log10(self.low_m)), math.ceil(math.log10(self.high_m)))
        digits = {1: (1, 2, 3, 5, 7), 2: (1, 2, 3, 5, 7), 3: (1, 2, 5)}.get(len(decades), (1,))
        candidates = [digit * 10.0**decade for decade in decades for digit in digits]
        return [value for value in candidates if self.low_m <= value <= self.high_m]


def depth_scale(*depths: NDArray[np.floating]) -> DepthScale:
    """Returns the scale over the 2nd to 98th percentile of all known depths together."""
    values = [np.asarray(d, dtype=np.float64).ravel() for d in depths]
    known = np.concatenate([v[np.isfinite(v) & (v > 0)] for v in values])
    if known.size == 0:
        return DepthScale(low_m=1.0, high_m=2.0)
    low, high = (float(v) for v in np.percentile(known, (2, 98)))
    if high - low < 0.01 * low:  # a single depth still needs a bar with two ends
        low, high = 0.95 * low, 1.05 * high
    return DepthScale(low_m=low, high_m=high)


def round_steps(low: float, high: float) -> list[float]:
    """Returns multiples of 1, 2 or 5 times a power of ten within the range, at most eleven."""
    rough = (high - low) / 10
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(m * power for m in (1, 2, 5, 10) if m * power >= rough)
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [index * step for index in range(first, last + 1)]


def grey_of(rgb: NDArray[np.floating]) -> NDArray[np.float32]:
    """Returns (H, W) luma in 0..1 of an (H, W, 3) or (H, W) image in 0..1."""
    image = np.clip(np.nan_to_num(np.asarray(rgb, dtype=np.float32)), 0, 1)
    if image.ndim == 2:
        return image
    weights = np.array([0.299, 0.587, 0.114], dtype=np.float32)
    return np.asarray(image @ weights, dtype=np.float32)


def dim(grey: NDArray[np.float32]) -> Pixels:
    """Returns an (H, W, 3) dark grey image, on which coloured points stand out."""
    levels = np.rint(20 + 115 * grey).astype(np.uint8)
    return np.repeat(levels[:, :, None], 3, axis=2)


def paint_signed(
    strength: NDArray[np.floating], light: NDArray[np.floating], colors: str
) -> Pixels:
    """Returns (..., 3) colours of `_SIGNED` from -1 to 1, around the grey `light` 0..1 at 0."""
    above, below = _SIGNED[colors]
    signed = np.asarray(strength, dtype=np.float32)[..., None]
    amount = np.clip(np.abs(signed), 0, 1)
    base = 255 * np.asarray(light, dtype=np.float32)[..., None]
    hue = np.where(signed > 0, np.asarray(above, np.float32), np.asarray(below, np.float32))
    return np.asarray(np.rint((1 - amount) * base + amount * hue), dtype=np.uint8)


def signed_bar(colors: str, length: int) -> Pixels:
    """Returns (length, 3) colours of a legend of `paint_signed`."""
    return paint_signed(np.linspace(-1, 1, length), np.full(length, 0.88), colors)


def hex_colours(colours: Pixels) -> list[str]:
    """Returns (N, 3) colours as #rrggbb."""
    return [f"#{bytes(colour).hex()}" for colour in colours]


def _turbo(position: NDArray[np.float64]) -> Pixels:
    levels = np.arange(256, dtype=np.uint8)[:, None]
    table = cv2.applyColorMap(levels, cv2.COLORMAP_TURBO)[:, 0, ::-1]
    # The last tenths of turbo are so dark at both ends that near and far look alike.
    index = np.rint(12 + 231 * np.clip(position, 0, 1)).astype(np.intp)
    return np.array(table[index], dtype=np.uint8)


@dataclass(frozen=True, kw_only=True)
class Panel:
    """An image with a title and a fainter remark above it."""

    title: str
    pixels: Pixels
    """(H, W, 3)."""
    remark: str = ""


def magnification(shape: tuple[int, ...], *, columns: int, legend: bool) -> float:
    """Returns the factor by which an image fits its column, a whole number if it enlarges.

    The image is (H, W, ...); `legend` is for a colour bar beside the columns.
    """
    height, width = shape[:2]
    room = FIGURE_WIDTH - 2 * MARGIN - (columns - 1) * GAP - (_LEGEND_WIDTH if legend else 0)
    fit = min(room / columns / width, _MAX_PANEL_HEIGHT / height)
    return math.floor(fit) if fit >= 1 else fit


def resized(pixels: NDArray[Any], factor: float, *, smooth: bool = False) -> NDArray[Any]:
    """Returns the image at `factor` times its size; enlarged pixels stay square unless `smooth`."""
    height, width = pixels.shape[:2]
    size = (max(1, round(width * factor)), max(1, round(height * factor)))
    enlarging = cv2.INTER_CUBIC if smooth else cv2.INTER_NEAREST
    method = cv2.INTER_AREA if factor < 1 else enlarging
    return np.asarray(cv2.resize(pixels, size, interpolation=method))


def draw_discs(
    grey: NDArray[np.float32],
    xy: NDArray[np.floating],
    colours: Pixels,
    factor: float,
    order: NDArray[np.intp],
) -> Pixels:
    """Returns the dark grey image (H, W), enlarged by `factor`, with a disc at each of N points.

    Pixel coordinates (N, 2) are those of the image; `order` has the topmost point last.
    """
    canvas = np.ascontiguousarray(resized(dim(grey), factor, smooth=True))
    spacing = math.sqrt(canvas.shape[0] * canvas.shape[1] / max(len(xy), 1))
    radius = min(max(0.24 * spacing, 1.4), 6.0)
    centres = (np.asarray(xy, dtype=np.float64) + 0.5) * factor - 0.5
    fraction = 4  # OpenCV takes coordinates in sixteenths of a pixel
    sixteenths = np.rint(centres * (1 << fraction)).astype(int)
    rim = radius + 1.2 if radius >= 3 else 0.0
    for index in order:
        for size, ink in ((rim, (15, 15, 15)), (radius, colours[index].tolist())):
            if size:
                sixteenth, centre = round(size * (1 << fraction)), sixteenths[index].tolist()
                cv2.circle(canvas, centre, sixteenth, ink, -1, cv2.LINE_AA, fraction)
    return canvas


def save_depth_figure(
    path: Path, panels: list[Panel], scale: DepthScale, unit: str = "m", *, columns: int = 1
) -> FigureRecord:
    """Writes a PNG of panels, `columns` to a row, beside a bar of depth colours."""
    figure, draw, content = _lay_out(panels, columns, legend_width=_LEGEND_WIDTH)
    left = figure.width - MARGIN - _LEGEND_WIDTH + GAP
    top, bottom = MARGIN + _TITLE_HEIGHT, figure.height - MARGIN
    draw.text(
        (left, MARGIN + 5), "metres" if unit == "m" else unit, font=_font(_FONT_SIZE), fill=_INK
    )
    # Far at the top, as on an axis.
    spaced = np.geomspace if scale.logarithmic else np.linspace
    depths = spaced(scale.high_m, scale.low_m, bottom - top)
    bar = np.repeat(scale.paint(depths)[:, None], _BAR_WIDTH, axis=1)
    _paste(figure, bar, left, top)
    draw.rectangle((left - 1, top - 1, left + _BAR_WIDTH, bottom), outline=_LINE)
    for tick, label in _labels(scale.ticks()):
        y = bottom - 1 - float(scale.position(np.array(tick))) * (bottom - top - 1)
        right = left + _BAR_WIDTH
        draw.line((right, y, right + 6, y), fill=_INK, width=1)
        draw.text((right + 11, y), label, font=_font(_SMALL_FONT_SIZE), fill=_INK, anchor="lm")
    _save(figure, path)
    return replace(content, scale_m=(scale.low_m, scale.high_m))


def save_gain_figure(
    path: Path,
    panel: Panel,
    gain: NDArray[np.float64],
    *,
    amount: str,
    noun: str,
    unknown: str = "",
) -> tuple[float, FigureRecord]:
    """Writes a PNG of one map of N gains with a colour bar; returns the fraction above 0 first.

    `amount` is the gain of full colour, with its unit; `noun` what is counted; `unknown` what the
    dark pixels are, "" where there are none.
    """
    figure, draw, content = _lay_out(
        [panel], 1, least_width=_GAIN_LEGEND[0], legend_height=_GAIN_LEGEND[1]
    )
    improved = float((gain > 0).mean())
    worse = 100 * float((gain < 0).mean())
    footer = f"{100 * improved:.1f} % of {gain.size:,} {noun} improved, {worse:.1f} % worse"
    ends = (f"worse by {amount} or more", f"better by {amount} or more")
    bar = np.repeat(signed_bar("gain", 220)[None], 18, axis=0)
    font, small = _font(_FONT_SIZE), _font(_SMALL_FONT_SIZE)
    x, y = float(MARGIN), figure.height - MARGIN - 56
    draw.text((x, y), ends[0], font=small, fill=_INK, anchor="lm")
    x += draw.textlength(ends[0], font=small) + 12
    _paste(figure, bar, round(x), y - bar.shape[0] // 2)
    x += bar.shape[1] + 12
    draw.text((x, y), ends[1], font=small, fill=_INK, anchor="lm")
    x += draw.textlength(ends[1], font=small) + 2 * GAP
    if unknown:
        draw.rectangle((x, y - 9, x + 18, y + 9), fill=_UNKNOWN_GAIN)
        draw.text((x + 28, y), unknown, font=small, fill=_INK, anchor="lm")
    draw.text((MARGIN, y + 40), footer, font=font, fill=_INK, anchor="lm")
    _save(figure, path)
    return improved, replace(content, ends=ends, unknown=unknown or None, footer=footer)


def _save(figure: PIL.Image.Image, path: Path) -> None:
    with atomic_path(path) as temporary:
        figure.save(temporary, "PNG", compress_level=_FAST)


def _lay_out(
    panels: list[Panel],
    columns: int,
    *,
    legend_width: int = 0,
    legend_height: int = 0,
    least_width: int = 0,
) -> tuple[PIL.Image.Image, PIL.ImageDraw.ImageDraw, FigureRecord]:
    """A figure with its panels, for a legend beside or below them to be drawn on."""
    from PIL import Image, ImageDraw

    height, width = panels[0].pixels.shape[:2]
    rows = -(-len(panels) // columns)
    used = columns * width + (columns - 1) * GAP + legend_width
    width_px = max(used + 2 * MARGIN, least_width)
    row_height = _TITLE_HEIGHT + height
    height_px = 2 * MARGIN + rows * row_height + (rows - 1) * (GAP // 2) + legend_height
    figure = Image.new("RGB", (width_px, height_px), "white")
    draw = ImageDraw.Draw(figure)
    boxes = {}
    for index, panel in enumerate(panels):
        row, column = divmod(index, columns)
        x = MARGIN + column * (width + GAP)
        y = MARGIN + row * (row_height + GAP // 2)
        font = _font(_FONT_SIZE)
        draw.text((x, y + 4), panel.title, font=font, fill=_INK)
        indent = draw.textlength(panel.title, font=font) + 14
        draw.text((x + indent, y + 5), panel.remark, font=_font(_SMALL_FONT_SIZE), fill=_FAINT_INK)
        _paste(figure, panel.pixels, x, y + _TITLE_HEIGHT)
        boxes[panel.title] = (x, y + _TITLE_HEIGHT, width, height)
    return figure, draw, FigureRecord(size=figure.size, panels=boxes)


def _labels(ticks: list[float]) -> list[tuple[float, str]]:
    gaps = [b - a for a, b in pairwise(ticks)]
    smallest = min((each for each in (*gaps, *ticks[:1]) if each > 0), default=1.0)
    decimals = max(0, -math.floor(math.log10(smallest) + 1e-9))
    return [(tick, f"{tick:,.{decimals}f}") for tick in ticks]


def _paste(figure: PIL.Image.Image, pixels: Pixels, x: int, y: int) -> None:
    from PIL import Image

    figure.paste(Image.fromarray(np.ascontiguousarray(pixels)), (x, y))


def _font(size: int) -> Any:
    from PIL import ImageFont

    # Pillow's own font: the same everywhere. It has no en dash, minus or multiplication sign.
    return ImageFont.load_default(size)
