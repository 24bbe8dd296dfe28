"""The influential field: how far one sparse point reaches through a cut network, measured.

Both senses of the paper's term are measured: the patch of z that the gradient of one point reaches
(5×5 for two 3×3 convolutions), and the patch of the output that changes when that patch of z does
(9×9 there).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from pnpdepth_cli.core.split import Split, gradient_at

_POSITIONS = ((0.5, 0.5), (0.35, 0.4), (0.65, 0.6))
"""Where points are placed, as fractions of height and width; inactive units may hide a part at
one position."""


@dataclass(frozen=True)
class InfluentialField:
    """The sizes of both patches, (height, width)."""

    in_z: tuple[int, int] | None
    """Of the patch of z, in elements; None if z has no two spatial axes."""
    in_output: tuple[int, int]
    """Of the patch of the output, in pixels."""


def influential_field(
    split: Split, z: Tensor, depth_of: Callable[[object], Tensor]
) -> InfluentialField:
    """Returns the largest patches over a few points near the centre of the image.

    The sizes are lower bounds: connections through units that are zero for this image do not count.

    Args:
        split: The network, cut and open.
        z: z_0, as returned by `split.front`.
        depth_of: Turns the network's output into depth (1, 1, h, w).
    """
    fields = [_at(split, z, depth_of, position) for position in _POSITIONS]
    patches = [field.in_z for field in fields if field.in_z is not None]
    outputs = [field.in_output for field in fields]
    return InfluentialField(_largest(patches) if patches else None, _largest(outputs))


def _at(
    split: Split, z: Tensor, depth_of: Callable[[object], Tensor], position: tuple[float, float]
) -> InfluentialField:
    z = z.detach().requires_grad_(True)
    with torch.enable_grad():
        depth = depth_of(split.rear(z))
        height, width = depth.shape[-2:]
        point = depth[..., int(height * position[0]), int(width * position[1])].sum()
        gradient = gradient_at(z, point)
        if gradient is None:
            gradient = torch.zeros_like(z)
        # With gradients both times: without, torch may take a kernel that rounds differently.
        moved = z.detach() + z.detach().std(correction=0) * gradient.sign()
        changed = depth_of(split.rear(moved.requires_grad_(True))).detach() != depth.detach()
    return InfluentialField(_extent(gradient != 0) if z.ndim == 4 else None, _extent(changed))


def _extent(mask: Tensor) -> tuple[int, int]:
    """Height and width of the bounding box of the true elements of (…, h, w)."""
    flat = mask.reshape(-1, *mask.shape[-2:]).any(dim=0)
    rows, columns = flat.any(dim=1).nonzero(), flat.any(dim=0).nonzero()
    if not len(rows):
        return 0, 0
    return int(rows[-1] - rows[0]) + 1, int(columns[-1] - columns[0]) + 1


def _largest(patches: list[tuple[int, int]]) -> tuple[int, int]:
    return max(height for height, _ in patches), max(width for _, width in patches)
