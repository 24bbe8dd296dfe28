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
        _change_panel(before, after, grey, factor),
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
    pixels, strongest = dim(np.asarray(0.6 * grey, np.float32)), _strongest(values)
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


def _change_panel(before: Depth, after: Depth, grey: NDArray[np.float32], factor: float) -> Panel:
    """The signed change in metres."""
    both = (before > 0) & (after > 0) & np.isfinite(before) & np.isfinite(after)
    change = (after[both] - before[both]).astype(np.float64)
    pixels, strongest = _paint(change, both, grey, "change")
    remark = f"after - before: teal farther, purple nearer, full at {strongest:.3g}"
    return Panel(title="Change", pixels=resized(pixels, factor), remark=remark)


def improvement(
    before: Depth,
    after: Depth,
    truth: Depth,
    path: Path,
    *,
    image: NDArray[np.float32] | None,
    size: tuple[int, int],
    xy: NDArray[np.float32] | None = None,
    held_out: bool = False,
    unit: str = "m",
) -> tuple[float, FigureRecord]:
    """Writes a PNG of where |depth - truth| fell and rose, as figure 4(d) of the paper.

    Equal errors are neither better nor worse. The map has a pixel for each one where the truth and
    the refined depth are known, or a disc for each point.

    Args:
        before: (H, W), or (N,) at the points, before refinement.
        after: The same after refinement.
        truth: The same as measured, some of it known.
        path: The PNG.
        image: (H, W, 3) in 0..1, the ground of the map, if there is one.
        size: (H, W) of the map.
        xy: (N, 2) pixel coordinates of the points; None for maps.
        held_out: Whether the points were held out of the refinement, which the PNG says.
        unit: Name of the unit of depth.

    Returns:
        The fraction of pixels or points whose error fell, and what the figure shows.

    Raises:
        OutputError: The file cannot be written.
    """
    has_truth = np.isfinite(truth) & (truth > 0)
    known = has_truth & (after > 0)
    gain = _gain(before[known], after[known], truth[known])
    grey, factor = grey_of(image, size), magnification(size)
    # A map, or the points with the largest changes on top.
    if xy is None:
        painted, strongest = _paint(gain, known, grey, "gain")
        pixels, noun = resized(painted, factor), "pixels"
    else:
        strongest, noun = _strongest(gain), "held-out points" if held_out else "points used"
        colours = paint_signed(gain / strongest, np.full(len(gain), 0.92), "gain")
        weakest_first = np.argsort(np.abs(gain), kind="stable")
        pixels = draw_discs(0.8 * grey, xy[known], colours, factor, weakest_first)
    # The figure, and its texts for a report.
    improved, worse = float((gain > 0).mean()), 100 * float((gain < 0).mean())
    footer = f"{100 * improved:.1f} % of {gain.size:,} {noun} improved, {worse:.1f} % worse"
    unknown = None if known.all() else "unknown" if (has_truth > known).any() else "no ground truth"
    remark = footer + (f"; dark: {unknown}" if unknown else "")
    panel = Panel(title="Change of error", pixels=pixels, remark=remark)
    labels = [f"{share * strongest:+.3g}" for share in (-1, -0.5, 0, 0.5, 1)]
    figure = save_figure(path, [panel], signed_bar("gain", 256), labels, f"gain, {unit}")
    amount = f"by {strongest:.3g} {unit} or more"
    ends = f"worse {amount}", f"better {amount}"
    return improved, replace(figure, ends=ends, unknown=unknown, footer=footer)


def _gain(before: Depth, after: Depth, gt: Depth) -> NDArray[np.float64]:
    """Metres by which the error fell; a depth that is not finite counts as an error of 1e9."""
    errors = (np.abs(depth.astype(np.float64) - gt.astype(np.float64)) for depth in (before, after))
    was, now = (np.nan_to_num(error, nan=1e9, posinf=1e9) for error in errors)
    return np.asarray(was - now, dtype=np.float64)


def _strongest(gain: NDArray[np.float64]) -> float:
    """The change in metres that has full colour."""
    changed = np.abs(gain[gain != 0])
    return float(np.percentile(changed, _STRONGEST_PERCENTILE)) if changed.size else 1.0
