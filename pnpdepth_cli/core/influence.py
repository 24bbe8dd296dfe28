"""The influential field: how far one sparse point reaches through a cut network, measured.

In both senses the paper's term is used: the patch of z that one point's gradient reaches (5×5 for
two 3×3 convolutions) and the patch of the output that moves when that patch of z does (9×9 there).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from pnpdepth_cli.core.split import Split, gradient_at

_PLACES = ((0.5, 0.5), (0.35, 0.4), (0.65, 0.6))
"""Where points are tried, as shares of height and width; dead units can hide a part at one."""


@dataclass(frozen=True)
class InfluentialField:
    """Both patches, as (height, width).

    in_z is in elements of z and None where z has no two spatial axes; in_output is in pixels.
    """

    in_z: tuple[int, int] | None
    in_output: tuple[int, int]


def influential_field(
    split: Split, z: Tensor, depth_of: Callable[[object], Tensor]
) -> InfluentialField:
    """The largest patches over a few points in the middle of the picture.

    z: what `split.front` gave. depth_of: as for `refine`. A part of the field behind units that are
    zero for this very picture is not seen, so the figure is a lower bound there.
    """
    fields = [_at(split, z, depth_of, place) for place in _PLACES]
    patches = [field.in_z for field in fields if field.in_z is not None]
    outputs = [field.in_output for field in fields]
    return InfluentialField(_largest(patches) if patches else None, _largest(outputs))


def _at(
    split: Split, z: Tensor, depth_of: Callable[[object], Tensor], place: tuple[float, float]
) -> InfluentialField:
    z = z.detach().requires_grad_(True)
    with torch.enable_grad():
        depth = depth_of(split.rear(z))
        height, width = depth.shape[-2:]
        point = depth[..., int(height * place[0]), int(width * place[1])].sum()
        gradient = gradient_at(z, point)
        if gradient is None:
            gradient = torch.zeros_like(z)
        # Like for like: without gradients torch may take another kernel, which rounds differently.
        moved = z.detach() + z.detach().std(correction=0) * gradient.sign()
        changed = depth_of(split.rear(moved.requires_grad_(True))).detach() != depth.detach()
    return InfluentialField(_extent(gradient != 0) if z.ndim == 4 else None, _extent(changed))


def _extent(mask: Tensor) -> tuple[int, int]:
    """Height and width of the box around the true elements of (..., h, w)."""
    flat = mask.reshape(-1, *mask.shape[-2:]).any(dim=0)
    rows, columns = flat.any(dim=1).nonzero(), flat.any(dim=0).nonzero()
    if not len(rows):
        return 0, 0
    return int(rows[-1] - rows[0]) + 1, int(columns[-1] - columns[0]) + 1


def _largest(patches: list[tuple[int, int]]) -> tuple[int, int]:
    return max(height for height, _ in patches), max(width for _, width in patches)
