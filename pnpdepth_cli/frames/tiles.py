"""A frame too large for the network's memory, refined tile by tile.

Tiles of one size overlap by a quarter. They are blended with weights that fall to 0 at their edges,
so that no seam is left. Below them lies the whole frame refined at the size of one tile: it shows
where a tile has too few points to be tied to metres.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray

from pnpdepth_cli.core.refine import OnIteration
from pnpdepth_cli.core.split import Split
from pnpdepth_cli.frames.frame import DepthMap, Frame, Refined, no_points
from pnpdepth_cli.frames.refine import refine_frame, with_propagation
from pnpdepth_cli.models.network import Network
from pnpdepth_cli.points import SparsePoints
from pnpdepth_cli.settings import Settings

OVERLAP = 0.25
"""Smallest overlap of two tiles, as a fraction of a tile's side."""
MIN_POINTS = 5
"""A tile with fewer points shows the whole frame's depth."""
_WHOLE_FRAME_WEIGHT = 1e-6


@dataclass(frozen=True)
class Tile:
    """Rows top … top + height and columns left … left + width of a frame."""

    top: int
    left: int
    height: int
    width: int

    def of(self, depth: DepthMap) -> DepthMap:
        """Returns this part of a map (H, W) as a view."""
        return depth[self.top : self.top + self.height, self.left : self.left + self.width]

    def points(self, points: SparsePoints) -> SparsePoints:
        """Returns the points in the tile, with coordinates in the tile."""
        return points.cropped(self.top, self.left, self.height, self.width)

    def part(self, frame: Frame, points: SparsePoints) -> Frame:
        """Returns this part of a frame with these points of the tile."""
        rgb = frame.rgb
        if rgb is not None:
            rgb = rgb[:, self.top : self.top + self.height, self.left : self.left + self.width]
        return Frame(rgb=None if rgb is None else rgb.contiguous(), points=points)

    def weights(self, size: tuple[int, int]) -> DepthMap:
        """Returns blending weights (height, width) in 0…1.

        They fall to 0 along the tile's edges, except those that are edges of the frame.
        """
        rows = _ramp(self.top, self.height, size[0])
        return np.outer(rows, _ramp(self.left, self.width, size[1])).astype(np.float32)


def tiles_of(size: tuple[int, int], side: int) -> list[Tile]:
    """Returns tiles of one size, at most side × side, that cover a frame (H, W) evenly."""
    height, width = (min(side, length) for length in size)
    return [
        Tile(top, left, height, width)
        for top in _starts(size[0], height)
        for left in _starts(size[1], width)
    ]


def refine_tiled(
    network: Network,
    split: Split,
    settings: Settings,
    frame: Frame,
    *,
    propagation: str = "none",
    on_iteration: OnIteration = lambda done, loss: None,
) -> Refined:
    """Returns the frame refined in tiles of at most `settings.tile` pixels on each side.

    A frame of one tile is refined as it is. For others, the whole frame is refined at reduced size
    too: it fills tiles with few points, and the result reports its losses, step size and alignment.
    Other arguments and errors are those of `refine_frame`.
    """
    assert settings.tile is not None
    tiles = tiles_of(frame.size, settings.tile)
    if len(tiles) == 1:
        return refine_frame(
            network, split, settings, frame, propagation=propagation, on_iteration=on_iteration
        )
    reduced = _reduced(frame, settings.tile)
    whole = refine_frame(network, split, settings, reduced, on_iteration=on_iteration)
    before, after = (
        _WHOLE_FRAME_WEIGHT * _enlarged(depth, frame.size) for depth in (whole.before, whole.after)
    )
    total = np.full(frame.size, _WHOLE_FRAME_WEIGHT, np.float32)
    diverged, skipped = whole.diverged, 0
    for tile in tiles:
        points = tile.points(frame.points)
        if len(points) < MIN_POINTS:
            skipped += 1
            continue
        part = refine_frame(network, split, settings, tile.part(frame, points))
        known = (part.before > 0) & (part.after > 0)
        weights = np.where(known, tile.weights(frame.size), 0)
        for sums, values in ((before, part.before), (after, part.after), (total, 1.0)):
            here = tile.of(sums)
            here += weights * values
        diverged = diverged or part.diverged
    note = f"tiles: {len(tiles)} of {tiles[0].width}×{tiles[0].height} pixels"
    if skipped:
        note += (
            f", {skipped} of them left as in the whole frame, with fewer than {MIN_POINTS} points"
        )
    return replace(
        whole,
        before=before / total,
        after=with_propagation(frame, after / total, propagation),
        used=frame.points,
        held_out=no_points(frame.points),
        diverged=diverged,
        notes=(*whole.notes, note),
    )


def _starts(length: int, part: int) -> list[int]:
    count = 1 + math.ceil((length - part) / max(1.0, part * (1 - OVERLAP)))
    return [round(at) for at in np.linspace(0, length - part, count)]


def _ramp(start: int, part: int, length: int) -> NDArray[np.float64]:
    """Weights along one side of a tile: linear over the smallest overlap."""
    position, overlap = np.arange(part) + 0.5, max(1.0, OVERLAP * part)
    before = position / overlap if start > 0 else np.ones(part)
    after = position[::-1] / overlap if start + part < length else np.ones(part)
    return np.minimum(np.minimum(before, after), 1.0)


def _reduced(frame: Frame, longest: int) -> Frame:
    """The whole frame with its longer side at this length."""
    height, width = frame.size
    factor = longest / max(height, width)
    size = max(1, round(height * factor)), max(1, round(width * factor))
    rgb = frame.rgb
    if rgb is not None:
        rgb = F.interpolate(rgb[None], size, mode="bilinear", antialias=True)[0]
    return Frame(rgb=rgb, points=frame.points.resized(*size))


def _enlarged(depth: DepthMap, size: tuple[int, int]) -> DepthMap:
    grown = F.interpolate(torch.from_numpy(depth)[None, None], size, mode="bilinear")
    enlarged: DepthMap = grown[0, 0].numpy()
    return enlarged
