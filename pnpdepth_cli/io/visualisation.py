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
    save_gain_figure,
)

Depth = NDArray[np.float32]

# Wider images than this (KITTI is 3.3 : 1) are stacked; two in a row would be too small.
_WIDE = 2.0
_STRONGEST_PERCENTILE = 95.0
_GAIN = "|before - ground truth| - |after - ground truth|"


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
    factor = magnification(before.shape, columns=columns, legend=True)
    scale = depth_scale(sparse_depth, before, after)
    # Without an image, the depth in grey is the ground of the points.
    grey = grey_of(rgb) if rgb is not None else (1 - scale.position(after)).astype(np.float32)
    first = rgb if rgb is not None else np.repeat(0.25 + 0.65 * grey[:, :, None], 3, axis=2)
    panels = [
        Panel(
            title="Image" if rgb is not None else "No image",
            pixels=resized(_bytes(first), factor, smooth=True),
            remark="" if rgb is not None else "depth in grey",
        ),
        _points_panel(grey, sparse_xy, sparse_depth, scale, factor),
        *(
            Panel(title=title, pixels=resized(scale.paint(depth), factor), remark=remark)
            for title, depth, remark in zip(
                ("Depth before", "Depth after"), (before, after), made_by, strict=True
            )
        ),
        _change_panel(before, after, grey, factor),
    ]
    return save_depth_figure(path, panels, scale, unit, columns=columns)


def overlay(
    rgb: NDArray[np.float32], xy: NDArray[np.float32], depth: NDArray[np.float32], path: Path
) -> None:
    """Writes a PNG with N points in the colours of their depth on the grey image, nearest on top.

    The image is (H, W, 3) in 0..1, the points are (N, 2) pixel coordinates and (N,) metres.
    """
    scale = depth_scale(depth)
    factor = magnification(rgb.shape, columns=1, legend=True)
    panel = _points_panel(grey_of(rgb), xy, depth, scale, factor)
    save_depth_figure(path, [panel], scale)


def sigma_preview(sigma: Depth, path: Path, unit: str = "m") -> None:
    """Writes a PNG of a standard deviation (H, W) in `unit`."""
    scale = replace(depth_scale(sigma), warm_is_far=True)
    factor = magnification(sigma.shape, columns=1, legend=True)
    panel = Panel(title="Standard deviation", pixels=resized(scale.paint(sigma), factor))
    save_depth_figure(path, [panel], scale, unit)


def write_mask(path: Path, mask: NDArray[np.bool_]) -> None:
    """Writes an 8-bit PNG, 255 where the mask (H, W) is true and 0 elsewhere."""
    from PIL import Image

    with atomic_path(path) as temporary:
        Image.fromarray(np.where(mask, np.uint8(255), np.uint8(0))).save(temporary, "PNG")


def _paint(
    values: NDArray[np.float64],
    where: NDArray[np.bool_],
    grey: NDArray[np.float32] | None,
    colors: str,
) -> tuple[Pixels, float]:
    """A map of signed values in colours on the dark grey image, and the value of full colour."""
    ground = np.full(where.shape, 0.3, np.float32) if grey is None else grey
    pixels, strongest = dim(np.asarray(0.6 * ground, np.float32)), _strongest(values)
    pixels[where] = paint_signed(values / strongest, 0.66 + 0.3 * ground[where], colors)
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
    image: NDArray[np.float32] | None = None,
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
        image: (H, W, 3) or (H, W) in 0..1, the ground of the map; needed for points.
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
    grey = None if image is None else grey_of(image)
    if xy is None:
        pixels, strongest = _paint(gain, known, grey, "gain")
        pixels = resized(pixels, magnification(truth.shape, columns=1, legend=False))
        noun, remark = "pixels", _GAIN
    else:
        assert grey is not None
        strongest = _strongest(gain)
        colours = paint_signed(gain / strongest, np.full(len(gain), 0.92), "gain")
        weakest_first = np.argsort(np.abs(gain), kind="stable")
        factor = magnification(grey.shape, columns=1, legend=False)
        pixels = draw_discs(0.8 * grey, xy[known], colours, factor, weakest_first)
        noun = "held-out points" if held_out else "points used"
        remark = f"at {len(gain):,} {noun}" if held_out else f"at the {len(gain):,} sparse {noun}"
    panel = Panel(title="Change of error", pixels=pixels, remark=remark)
    unknown = "" if known.all() else "unknown" if (has_truth > known).any() else "no ground truth"
    amount = f"{strongest:.3g} {unit}"
    return save_gain_figure(path, panel, gain, amount=amount, noun=noun, unknown=unknown)


def _gain(before: Depth, after: Depth, gt: Depth) -> NDArray[np.float64]:
    """Metres by which the error fell; a depth that is not finite counts as an error of 1e9."""
    errors = (np.abs(depth.astype(np.float64) - gt.astype(np.float64)) for depth in (before, after))
    was, now = (np.nan_to_num(error, nan=1e9, posinf=1e9) for error in errors)
    return np.asarray(was - now, dtype=np.float64)


def _strongest(gain: NDArray[np.float64]) -> float:
    """The change in metres that has full colour."""
    changed = np.abs(gain[gain != 0])
    return float(np.percentile(changed, _STRONGEST_PERCENTILE)) if changed.size else 1.0


def _bytes(image: NDArray[np.floating]) -> NDArray[np.uint8]:
    return np.asarray(np.rint(255 * np.clip(np.nan_to_num(image), 0, 1)), dtype=np.uint8)
