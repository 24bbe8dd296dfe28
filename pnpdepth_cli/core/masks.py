"""Which of a frame's points are hidden from the network's input, so that it can be asked for them.

Random points suit points that lie at random. Blocks and scan lines hide whole neighbourhoods, as
where the depth between a LiDAR's lines is wanted.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from pnpdepth_cli.points import SparsePoints
from pnpdepth_cli.settings import Settings

BLOCKS = 8
"""Blocks along each side of the frame."""
LINES = 64
"""Bands of rows, about one for each scan line of a LiDAR."""
SET_ASIDE = 0.1
"""Fraction of the points never shown; the step that is best there is taken."""
LEAST_SET_ASIDE = 4
"""Points set aside at least; with fewer than four times as many points, a quarter."""

Groups = Callable[[SparsePoints, torch.Generator], Tensor]
"""(N,) int64: the group of each point; a group is hidden or shown as a whole."""


def _points(points: SparsePoints, generator: torch.Generator) -> Tensor:
    return torch.arange(len(points))


def _blocks(points: SparsePoints, generator: torch.Generator) -> Tensor:
    """Blocks of the frame, whose borders lie elsewhere each time."""
    size = torch.tensor([points.size[1], points.size[0]])
    shift = torch.rand(2, generator=generator)
    column, row = (points.xy.cpu() / size * BLOCKS + shift).long().unbind(1)
    return row * (BLOCKS + 1) + column


def _lines(points: SparsePoints, generator: torch.Generator) -> Tensor:
    shift = torch.rand(1, generator=generator)
    return (points.xy.cpu()[:, 1] / points.size[0] * LINES + shift).long()


MASKS: dict[str, Groups] = {"points": _points, "blocks": _blocks, "lines": _lines}
"""The kinds of mask; `choices.MASKS` lists their names."""


class Masks:
    """Masks of one frame's points, one for each step.

    The points are divided into parts at random, and every part is hidden once before the points are
    divided anew: masks that complement each other make steps that agree more than independent ones.

    Args:
        points: The N points that may be hidden.
        settings: `mask` and `mask_fraction`, which are not open. A fraction of 1/3 makes three
            parts; above 1/2, one part is shown and all others are hidden.
    """

    def __init__(
        self, points: SparsePoints, settings: Settings, generator: torch.Generator
    ) -> None:
        self._points, self._settings, self._generator = points, settings, generator
        self._shows_one = settings.mask_fraction > 0.5
        smaller = 1 - settings.mask_fraction if self._shows_one else settings.mask_fraction
        self._parts = max(2, round(1 / smaller))
        self._part, self._next = torch.empty(0), self._parts

    def next(self) -> Tensor:
        """Returns (N,) true where a point is hidden."""
        if len(self._points) < 2:
            return torch.zeros(len(self._points), dtype=torch.bool)
        if self._next >= min(self._parts, len(self._points)):
            self._part, self._next = self._divided(), 0
        hidden = (self._part == self._next) ^ self._shows_one
        self._next += 1
        return hidden.to(self._points.depth.device)

    def _divided(self) -> Tensor:
        """(N,) the part of each point; no part is empty if there are enough points."""
        _, group = torch.unique(
            MASKS[self._settings.mask](self._points, self._generator), return_inverse=True
        )
        if int(group.max()) + 1 < self._parts:  # too few blocks or lines
            group = torch.arange(len(self._points))
        groups = int(group.max()) + 1
        return (torch.randperm(groups, generator=self._generator) % self._parts)[group]


def set_aside(points: SparsePoints, fraction: float, generator: torch.Generator) -> Tensor:
    """Returns (N,) true where a point is never shown while the steps are made."""
    aside = torch.zeros(len(points), dtype=torch.bool)
    if fraction:
        least = min(LEAST_SET_ASIDE, len(points) // 4)
        count = max(least, round(fraction * len(points)))
        aside[torch.randperm(len(points), generator=generator)[:count]] = True
    return aside.to(points.depth.device)
