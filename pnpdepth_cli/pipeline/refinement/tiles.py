"""A frame too large for the network's memory, refined tile by tile.

Tiles of one size overlap by a quarter and are blended with weights that fall to 0 at their edges,
so that no seam is left. Beneath them lies the whole frame refined at the size of one tile: it is
what tiles without enough points, which nothing ties to metres there, leave to be seen.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray

from pnpdepth_cli.core.refine import RefineSettings
from pnpdepth_cli.core.split import Split
from pnpdepth_cli.models.network import Network
from pnpdepth_cli.pipeline.refinement.frame import (
    FrameToRefine,
    RefinedFrame,
    propagated,
    refine_frame,
)
from pnpdepth_cli.pipeline.refinement.inputs import Inputs
from pnpdepth_cli.points import SparsePoints

OVERLAP = 0.25
"""Of a tile's side, at least."""
FEWEST = 5
"""Points of a tile; with fewer it is left to the whole frame's depth."""
_BENEATH = 1e-6
"""The weight of the whole frame's depth."""


@dataclass(frozen=True)
class Tile:
    """Rows top … top + height and columns left … left + width of a frame."""

    top: int
    left: int
    height: int
    width: int

    def of(self, picture: NDArray[np.float32]) -> NDArray[np.float32]:
        """This part of a picture (H, W, …), in the picture's memory."""
        return picture[self.top : self.top + self.height, self.left : self.left + self.width]

    def points(self, points: SparsePoints) -> SparsePoints:
        """The frame's points that lie in it, at their places in the tile."""
        return points.cropped(self.top, self.left, self.height, self.width)

    def weights(self, size: tuple[int, int]) -> NDArray[np.float32]:
        """(height, width) in 0…1: down to 0 along an edge, but for those of the frame itself."""
        rows = _ramp(self.top, self.height, size[0])
        return np.outer(rows, _ramp(self.left, self.width, size[1])).astype(np.float32)


def tiles_of(size: tuple[int, int], side: int) -> list[Tile]:
    """Tiles of one size, at most side × side, that cover the frame (H, W) evenly."""
    height, width = (min(side, length) for length in size)
    return [
        Tile(top, left, height, width)
        for top in _starts(size[0], height)
        for left in _starts(size[1], width)
    ]


def _starts(length: int, part: int) -> list[int]:
    count = 1 + math.ceil((length - part) / max(1.0, part * (1 - OVERLAP)))
    return [round(at) for at in np.linspace(0, length - part, count)]


def _ramp(start: int, part: int, length: int) -> NDArray[np.float64]:
    """Weights along one side of a tile: straight lines over the overlap it has at least."""
    place, overlap = np.arange(part) + 0.5, max(1.0, OVERLAP * part)
    before = place / overlap if start > 0 else np.ones(part)
    after = place[::-1] / overlap if start + part < length else np.ones(part)
    return np.minimum(np.minimum(before, after), 1.0)


def refine_tiled(
    network: Network,
    split: Split,
    settings: RefineSettings,
    task: FrameToRefine,
    side: int,
    *,
    on_iteration: Callable[[int, float], None] = lambda done, loss: None,
) -> RefinedFrame:
    """The frame refined in tiles of at most side × side pixels; a small one in one piece.

    What is said of the refinement (losses, step, alignment) is that of the whole frame at reduced
    size. on_iteration is called for that, too.
    """
    size = task.inputs.size
    tiles = tiles_of(size, side)
    if len(tiles) == 1:
        return refine_frame(network, split, settings, task, on_iteration=on_iteration)
    whole = refine_frame(network, split, settings, _reduced(task, side), on_iteration=on_iteration)
    before, after = (_BENEATH * _enlarged(depth, size) for depth in (whole.before, whole.after))
    total = np.full(size, _BENEATH, np.float32)
    diverged, without = whole.diverged, 0
    for tile in tiles:
        points = tile.points(task.used)
        if len(points) < FEWEST:
            without += 1
            continue
        part = refine_frame(network, split, settings, _part(task.inputs, tile, points))
        known = (part.before > 0) & (part.after > 0)
        weights = np.where(known, tile.weights(size), 0)
        for sums, values in ((before, part.before), (after, part.after), (total, 1.0)):
            here = tile.of(sums)
            here += weights * values
        diverged = diverged or part.diverged
    said = f"tiles: {len(tiles)} of {tiles[0].width}×{tiles[0].height} pixels"
    if without:
        said += f", {without} of them left as in the whole frame, with fewer than {FEWEST} points"
    return replace(
        whole,
        before=before / total,
        after=propagated(task, after / total),
        used=task.used,
        held_out=task.held_out,
        diverged=diverged,
        notes=(*whole.notes, said),
    )


def _part(inputs: Inputs, tile: Tile, points: SparsePoints) -> FrameToRefine:
    rgb = None if inputs.rgb is None else tile.of(inputs.rgb)
    return FrameToRefine.with_points(replace(inputs, rgb=rgb, points=points, gt=None), points)


def _reduced(task: FrameToRefine, longest: int) -> FrameToRefine:
    """The whole frame with its longer side at this length, and nothing left to propagate."""
    height, width = task.inputs.size
    factor = longest / max(height, width)
    size = max(1, round(height * factor)), max(1, round(width * factor))
    rgb = task.inputs.rgb_tensor()
    if rgb is not None:
        rgb = F.interpolate(rgb, size, mode="bilinear", antialias=True)[0].permute(1, 2, 0)
    points = task.used.resized(*size)
    inputs = replace(task.inputs, rgb=None if rgb is None else rgb.numpy(), points=points, gt=None)
    return FrameToRefine.with_points(inputs, points)


def _enlarged(depth: NDArray[np.float32], size: tuple[int, int]) -> NDArray[np.float32]:
    grown = F.interpolate(torch.from_numpy(depth)[None, None], size, mode="bilinear")
    enlarged: NDArray[np.float32] = grown[0, 0].numpy()
    return enlarged
