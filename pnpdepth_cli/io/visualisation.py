"""PNGs for people: inputs, depth before and after, its uncertainty, and where refinement helped."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.file_record import FigureRecord
from pnpdepth_cli.io.atomic import atomic_path
from pnpdepth_cli.io.figure import (
    DepthScale,
    Panel,
    Pixels,
    depth_scale,
    dim,
    draw_discs,
    grey_of,
    magnification,
    paint_signed,
    resized,
    save_depth_figure,
    save_figure,
    signed_bar,
)

Depth = NDArray[np.float32]

# Wider images than this (KITTI is 3.3 : 1) are stacked; two in a row would be too small.
_WIDE = 2.0
_STRONGEST_PERCENTILE = 95.0


def preview(
    rgb: NDArray[np.float32] | None,
    sparse_xy: NDArray[np.float32],
    sparse_depth: Depth,
    before: Depth,
    after: Depth,
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
    factor = magnification(before.shape, columns=columns)
    scale, grey = depth_scale(sparse_depth, before, after), grey_of(rgb, before.shape)
    panels = [
        _points_panel(grey, sparse_xy, sparse_depth, scale, factor),
        *(
            Panel(title=title, pixels=resized(scale.paint(depth), factor), remark=remark)
            for title, depth, remark in zip(
                ("Depth before", "Depth after"), (before, after), made_by, strict=True
            )
        ),
        _change_panel(before, after, grey, factor, unit),
    ]
    if rgb is not None:
        image = np.rint(255 * np.clip(np.nan_to_num(rgb), 0, 1)).astype(np.uint8)
        panels.insert(0, Panel(title="Image", pixels=resized(image, factor, smooth=True)))
    return save_depth_figure(path, panels, scale, unit, columns=columns)


def overlay(
    rgb: NDArray[np.float32], xy: NDArray[np.float32], depth: NDArray[np.float32], path: Path
) -> None:
    """Writes a PNG with N points in the colours of their depth on the grey image, nearest on top.

    The image is (H, W, 3) in 0..1, the points are (N, 2) pixel coordinates and (N,) metres.
    """
    scale, grey = depth_scale(depth), grey_of(rgb, rgb.shape)
    panel = _points_panel(grey, xy, depth, scale, magnification(rgb.shape))
    save_depth_figure(path, [panel], scale)


def write_mask(path: Path, mask: NDArray[np.bool_]) -> None:
    """Writes an 8-bit PNG, 255 where the mask (H, W) is true and 0 elsewhere."""
    from PIL import Image

    with atomic_path(path) as temporary:
        Image.fromarray(np.where(mask, np.uint8(255), np.uint8(0))).save(temporary, "PNG")


def _paint(
    values: NDArray[np.float64], where: NDArray[np.bool_], grey: NDArray[np.float32], colors: str
) -> tuple[Pixels, float]:
    """A map of signed values in colours on the dark grey image, and the value of full colour."""
    pixels, changed = dim(np.asarray(0.6 * grey, np.float32)), np.abs(values[values != 0])
    strongest = float(np.percentile(changed, _STRONGEST_PERCENTILE)) if changed.size else 1.0
    pixels[where] = paint_signed(values / strongest, 0.66 + 0.3 * grey[where], colors)
    return pixels, strongest


def _points_panel(
    grey: NDArray[np.float32],
    xy: NDArray[np.float32],
    depth: Depth,
    scale: DepthScale,
    factor: float,
) -> Panel:
    """The points in the colours of their depth on the grey image, nearest on top."""
    far_first = np.argsort(-depth, kind="stable")
    discs = draw_discs(grey, xy, scale.paint(depth), factor, far_first)
    count = f"{len(depth):,} point{'' if len(depth) == 1 else 's'}"
    return Panel(title="Sparse depth", pixels=discs, remark=count)


def _change_panel(
    before: Depth, after: Depth, grey: NDArray[np.float32], factor: float, unit: str
) -> Panel:
    """The signed change."""
    both = (before > 0) & (after > 0) & np.isfinite(before) & np.isfinite(after)
    change = (after[both] - before[both]).astype(np.float64)
    pixels, strongest = _paint(change, both, grey, "change")
    remark = f"after - before: teal farther, purple nearer, full at {strongest:.3g} {unit}"
    return Panel(title="Change", pixels=resized(pixels, factor), remark=remark)


def improvement(
    rgb: NDArray[np.float32] | None,
    before: Depth,
    after: Depth,
    truth: Depth,
    path: Path,
    unit: str = "m",
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
    pixels, strongest = _paint(gains, known, grey_of(rgb, truth.shape), "gain")
    pixels = resized(pixels, magnification(truth.shape))
    # The figure, and its texts for a report.
    improved, worse = (100 * float(part.mean()) for part in (gains > 0, gains < 0))
    footer = f"{improved:.1f} % of {gains.size:,} pixels improved, {worse:.1f} % worse"
    unknown = None
    if not known.all():
        unknown = "unknown" if (truth[~known] > 0).any() else "no ground truth"
    remark = footer + (f"; dark: {unknown}" if unknown else "")
    panel = Panel(title="Change of error", pixels=pixels, remark=remark)
    labels = [f"{share * strongest:+.3g}" for share in (-1, -0.5, 0, 0.5, 1)]
    figure = save_figure(path, [panel], signed_bar("gain", 256), labels, f"gain, {unit}")
    amount = f"by {strongest:.3g} {unit} or more"
    ends = f"worse {amount}", f"better {amount}"
    return replace(figure, ends=ends, unknown=unknown, footer=footer)


def gain(before: Depth, after: Depth, truth: Depth) -> NDArray[np.float64]:
    """Returns by how much |depth - truth| fell; NaN where the truth or the depth after is unknown.

    A depth that is not finite counts as an error of 1e9.
    """
    known = np.isfinite(truth) & (truth > 0) & (after > 0)
    errors = (np.abs(depth.astype(np.float64) - truth) for depth in (before, after))
    was, now = (np.nan_to_num(error, nan=1e9, posinf=1e9) for error in errors)
    return np.where(known, was - now, np.nan)
