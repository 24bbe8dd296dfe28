"""A white figure with titled panels and a colour bar: the layout of every PNG for people."""

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
from pnpdepth_cli.io.colours import DepthScale, Pixels, dim, signed_bar

if TYPE_CHECKING:
    import PIL.Image
    import PIL.ImageDraw

FIGURE_WIDTH = 1600
MARGIN = 24
GAP = 20
_TITLE_HEIGHT = 34
_BAR_WIDTH = 22
_LEGEND_WIDTH = 112
_MAX_PANEL_HEIGHT = 1100
_GAIN_LEGEND = (900, 84)  # width its text needs, height
_FONT_SIZE = 19
_SMALL_FONT_SIZE = 17
_INK = (32, 33, 36)
_FAINT_INK = (95, 99, 104)
_LINE = (200, 202, 206)
_UNKNOWN_GAIN = (52, 52, 52)
_FAST = 2  # zlib's level: a third of the time of its default 6, files a tenth larger


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
