"""PNGs for people: inputs and depth before and after, and where refinement helped."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.errors import InputError, NoPointsError, SizeError
from pnpdepth_cli.io.colours import (
    DepthScale,
    depth_scale,
    dimmed,
    grey_of,
    paint_change,
    paint_gain,
)
from pnpdepth_cli.io.page import (
    Panel,
    depth_page,
    draw_discs,
    gain_page,
    magnification,
    resized,
    save_page,
)
from pnpdepth_cli.io.uncertainty_images import hatched

Depth = NDArray[np.float32]

# Wider images than this (KITTI is 3.3 : 1) are stacked; two in a row would be too small.
_WIDE = 2.0
_STRONGEST_PERCENTILE = 95.0
_ZOOM = 4  # the zoom shows this fraction of the image's sides
_FEW = 20  # points
_FRAME = (230, 30, 30)
_GAIN = "|before - ground truth| - |after - ground truth|"


def preview(
    rgb: NDArray[np.float32] | None,
    sparse_xy: NDArray[np.float32],
    sparse_depth: Depth,
    before: Depth,
    after: Depth,
    path: Path,
    unit: str = "m",
    *,
    valid: NDArray[np.bool_] | None = None,
) -> None:
    """Writes a PNG of image, sparse depth, depth before and after, and what changed.

    All depth panels have one colour scale. The last two show the signed change, and a close-up of
    before and after where the change is largest.

    Args:
        rgb: (H, W, 3) in 0..1; None for a network without image.
        sparse_xy: (N, 2) pixel coordinates.
        sparse_depth: (N,) in `unit`.
        before: (H, W) in `unit`, before refinement.
        after: (H, W) in `unit`, after refinement.
        path: The PNG.
        unit: Name of the unit of all depths, for the legend.
        valid: (H, W); the depth after is hatched where false. None: all is valid.

    Raises:
        SizeError: Image and depth differ in size.
        OutputError: The file cannot be written.
    """
    _check_same_size(before, after=after, image=rgb, mask=valid)
    height, width = before.shape
    columns = 1 if width > _WIDE * height else 2
    factor = magnification(before.shape, columns=columns, legend=True)
    scale = depth_scale(sparse_depth, before, after)
    # Without an image, the depth in grey is the ground of the points.
    grey = grey_of(rgb) if rgb is not None else (1 - scale.position(after)).astype(np.float32)
    first = rgb if rgb is not None else np.repeat(0.25 + 0.65 * grey[:, :, None], 3, axis=2)
    ground = resized(dimmed(grey), factor, smooth=True)
    far_first = np.argsort(-sparse_depth, kind="stable")
    discs = draw_discs(ground, sparse_xy, scale.paint(sparse_depth), factor, far_first)
    count = f"{len(sparse_depth):,} point{'' if len(sparse_depth) == 1 else 's'}"
    panels = [
        Panel(
            title="Image" if rgb is not None else "No image",
            pixels=resized(_bytes(first), factor, smooth=True),
            remark="" if rgb is not None else "depth in grey",
        ),
        Panel(title="Sparse depth", pixels=discs, remark=count),
        Panel(title="Depth before", pixels=resized(scale.paint(before), factor)),
        Panel(
            title="Depth after",
            pixels=hatched(resized(scale.paint(after), factor), valid),
            remark="" if valid is None or valid.all() else "hatched: not valid",
        ),
        *_change_panels(before, after, scale, grey, _area(sparse_xy)),
    ]
    save_page(depth_page(panels, columns, scale, unit), path)


def _change_panels(
    before: Depth,
    after: Depth,
    scale: DepthScale,
    grey: NDArray[np.float32],
    of_points: tuple[slice, slice],
) -> list[Panel]:
    """The signed change in metres, and before and after side by side where most changed.

    Only the rows and columns with points count for the zoom: elsewhere, such as in the sky, the
    depth has nothing to follow.
    """
    columns = 1 if before.shape[1] > _WIDE * before.shape[0] else 2
    factor = magnification(before.shape, columns=columns, legend=True)
    both = (before > 0) & (after > 0) & np.isfinite(before) & np.isfinite(after)
    change = np.where(both, np.nan_to_num(after) - np.nan_to_num(before), 0).astype(np.float64)
    strongest = _strongest(change[both])
    pixels = dimmed(0.6 * grey)
    pixels[both] = paint_change(change[both] / strongest, 0.66 + 0.3 * grey[both])
    relative = np.zeros_like(change)
    relative[of_points] = (np.abs(change) / np.where(both, after, 1))[of_points]
    top, left, height, width = _most_changed(relative)
    shown = resized(pixels, factor)
    low = (round(left * factor), round(top * factor))
    high = (round((left + width) * factor) - 1, round((top + height) * factor) - 1)
    cv2.rectangle(shown, low, high, _FRAME, 2)
    area = np.s_[top : top + height, left : left + width]
    size = (shown.shape[1] // 2, shown.shape[0])
    halves = [
        cv2.resize(scale.paint(depth[area]), size, interpolation=cv2.INTER_NEAREST)
        if min(size) > 0
        else shown[:, :0]
        for depth in (before, after)
    ]
    zoom = np.full_like(shown, 255)
    zoom[:, : size[0]] = halves[0]
    zoom[:, shown.shape[1] - size[0] :] = halves[1]
    zoom[:, size[0] - 1 : shown.shape[1] - size[0] + 1] = 255
    return [
        Panel(
            title="Change",
            pixels=shown,
            remark=f"after - before: teal farther, purple nearer, full at {strongest:.3g}",
        ),
        Panel(title="Zoom", pixels=zoom, remark="before | after, where most changed (frame)"),
    ]


def _area(xy: NDArray[np.float32]) -> tuple[slice, slice]:
    """Rows and columns with points, without the outermost per cent; all for a few points."""
    if len(xy) < _FEW:
        return slice(None), slice(None)
    (left, top), (right, bottom) = np.percentile(xy, (1, 99), axis=0).astype(int)
    return slice(max(top, 0), bottom + 1), slice(max(left, 0), right + 1)


def _most_changed(relative: NDArray[np.float64]) -> tuple[int, int, int, int]:
    """Top, left, height and width of the window with the largest mean relative change.

    Its width is halved, because two windows stand side by side.
    """
    rows, columns = relative.shape
    height, width = max(1, rows // _ZOOM), max(1, columns // (2 * _ZOOM))
    bounded = np.minimum(relative, _strongest(relative))
    total = cv2.integral(bounded)
    window = (total[height:, width:] - total[:-height, width:] - total[height:, :-width]) + total[
        :-height, :-width
    ]
    top, left = np.unravel_index(int(window.argmax()), window.shape)
    return int(top), int(left), height, width


def improvement(
    before: Depth,
    after: Depth,
    gt: Depth,
    path: Path,
    *,
    rgb: NDArray[np.float32] | None = None,
    colors: str = "blue-orange",
) -> float:
    """Writes a PNG of where |depth - gt| fell and rose, as figure 4(d) of the paper.

    Only pixels with known ground truth count; equal errors are neither better nor worse.

    Args:
        before: (H, W) metres before refinement.
        after: (H, W) metres after refinement.
        gt: (H, W) metres of ground truth, 0 where unknown.
        path: The PNG.
        rgb: (H, W, 3) in 0..1, the ground of the map; None for grey.
        colors: One of `choices.COLORS`: blue better and orange worse, or red and green.

    Returns:
        The fraction of pixels whose error fell.

    Raises:
        InputError: No ground truth is known.
        SizeError: The images differ in size.
        OutputError: The file cannot be written.
    """
    _check_same_size(before, after=after, gt=gt, image=rgb)
    known = np.isfinite(gt) & (gt > 0)
    if not known.any():
        raise InputError("the ground truth has no pixel with known depth; give another file")
    gain = np.zeros(gt.shape, dtype=np.float64)
    gain[known] = _gain(before[known], after[known], gt[known])
    grey = grey_of(rgb) if rgb is not None else np.full(gt.shape, 0.3, dtype=np.float32)
    strongest = _strongest(gain[known])
    pixels = dimmed(0.6 * grey)
    pixels[known] = paint_gain(gain[known] / strongest, 0.66 + 0.3 * grey[known], colors)
    factor = magnification(gt.shape, columns=1, legend=False)
    swatch = None if known.all() else ((52, 52, 52), "no ground truth")
    panel = Panel(title="Change of error", pixels=resized(pixels, factor), remark=_GAIN)
    return _save_gain(
        panel,
        gain[known],
        _GainKey(amount=f"{strongest:.3g} m or more", swatch=swatch, noun="pixels", colors=colors),
        path,
    )


def improvement_at_points(
    rgb_or_grey: NDArray[np.float32],
    xy: NDArray[np.float32],
    depth: Depth,
    before_at: Depth,
    after_at: Depth,
    held_out: bool,
    path: Path,
    unit: str = "m",
    colors: str = "blue-orange",
) -> float:
    """Writes a PNG of where the error at sparse points fell and rose, as discs on the grey image.

    Args:
        rgb_or_grey: (H, W, 3) or (H, W) in 0..1.
        xy: (N, 2) pixel coordinates.
        depth: (N,) metres measured there.
        before_at: (N,) metres before refinement.
        after_at: (N,) metres after refinement.
        held_out: Whether refinement did not use the points, which the PNG says.
        path: The PNG.
        unit: Of all depths, where it is not the metre.
        colors: One of `choices.COLORS`.

    Returns:
        The fraction of points whose error fell.

    Raises:
        NoPointsError: There is no point.
        SizeError: Points and depths differ in number.
        OutputError: The file cannot be written.
    """
    if len(depth) == 0:
        raise NoPointsError("there is no sparse point to compare at; give more points")
    if not len(xy) == len(depth) == len(before_at) == len(after_at):
        raise SizeError("points and depths to compare differ in number; give one depth a point")
    gain = _gain(before_at, after_at, depth)
    strongest = _strongest(gain)
    grey = grey_of(rgb_or_grey)
    factor = magnification(grey.shape, columns=1, legend=False)
    ground = resized(dimmed(0.8 * grey), factor, smooth=True)
    colours = paint_gain(gain / strongest, np.full(len(gain), 0.92), colors)
    weakest_first = np.argsort(np.abs(gain), kind="stable")
    discs = draw_discs(ground, xy, colours, factor, weakest_first)
    remark = (
        f"at {len(gain):,} held-out points"
        if held_out
        else (f"at the {len(gain):,} sparse points used")
    )
    panel = Panel(title="Change of error", pixels=discs, remark=remark)
    noun = "held-out points" if held_out else "points used"
    amount = f"{strongest:.3g} {unit} or more"
    key = _GainKey(amount=amount, swatch=None, noun=noun, colors=colors)
    return _save_gain(panel, gain, key, path)


def _gain(before: Depth, after: Depth, gt: Depth) -> NDArray[np.float64]:
    """Metres by which the error fell; a depth that is not finite counts as an error of 1e9."""
    ground_truth = gt.astype(np.float64)
    was, now = (
        np.nan_to_num(np.abs(np.asarray(d, dtype=np.float64) - ground_truth), nan=1e9, posinf=1e9)
        for d in (before, after)
    )
    return np.asarray(was - now, dtype=np.float64)


def _strongest(gain: NDArray[np.float64]) -> float:
    """The change in metres that has full colour."""
    changed = np.abs(gain[gain != 0])
    return float(np.percentile(changed, _STRONGEST_PERCENTILE)) if changed.size else 1.0


@dataclass(frozen=True, kw_only=True)
class _GainKey:
    """What the colours of a map of gains mean."""

    amount: str
    """Change of full colour."""
    swatch: tuple[tuple[int, int, int], str] | None
    """A colour outside the bar and its meaning."""
    noun: str
    """What is counted."""
    colors: str
    """One of `choices.COLORS`."""


def _save_gain(panel: Panel, gain: NDArray[np.float64], key: _GainKey, path: Path) -> float:
    """Writes the panel with a colour bar and a footer. Returns the fraction with a gain above 0."""
    improved, worse = float((gain > 0).mean()), float((gain < 0).mean())
    strength = np.linspace(-1, 1, 220)
    bar = np.repeat(paint_gain(strength, np.full(220, 0.88), key.colors)[None], 18, axis=0)
    counted = f"{gain.size:,} {key.noun}"
    footer = f"{100 * improved:.1f} % of {counted} improved, {100 * worse:.1f} % worse"
    ends = (f"worse by {key.amount}", f"better by {key.amount}")
    save_page(gain_page(panel, bar, ends, key.swatch, footer), path)
    return improved


def _bytes(image: NDArray[np.floating]) -> NDArray[np.uint8]:
    return np.asarray(np.rint(255 * np.clip(np.nan_to_num(image), 0, 1)), dtype=np.uint8)


def _check_same_size(before: Depth, **others: NDArray[Any] | None) -> None:
    for name, other in others.items():
        if other is not None and other.shape[:2] != before.shape:
            sizes = " and ".join(f"{w}x{h}" for h, w in (before.shape, other.shape[:2]))
            raise SizeError(f"depth and {name} differ in size ({sizes}); give matching files")
