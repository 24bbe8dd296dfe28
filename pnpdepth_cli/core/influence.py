"""The influential field: how far one sparse point reaches through a cut network, measured.

Both senses of the paper's term are measured: the patch of z that the gradient of one point reaches
(5×5 for two 3×3 convolutions), and the patch of the output that changes when that patch of z does
(9×9 there).
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from pnpdepth_cli.core.split import Split
from pnpdepth_cli.errors import wrap_user_errors

_POSITIONS = ((0.5, 0.5), (0.35, 0.4), (0.65, 0.6))
"""Where points are placed, as fractions of height and width; inactive units may hide a part at
one position."""


Patch = tuple[int, int]
"""Height and width of a patch."""


def influential_field(
    split: Split, z: Tensor, depth_of: Callable[[object], Tensor], enough: float | None = None
) -> tuple[Patch | None, Patch]:
    """Returns the largest patch of z in elements, and of the output in pixels.

    They are those of a few points near the centre of the image. The sizes are lower bounds:
    connections through units that are zero for this image do not count. The patch of z is None if
    z has no two spatial axes.

    Args:
        z: z_0, as returned by `split.front`.
        depth_of: Turns the network's output into depth (1, 1, h, w).
        enough: Rows and columns that the patch of the output is compared with. No further point is
            tried once it has as many, or, since points differ little, fewer than half. None
            tries every point.
    """
    z = z.detach().requires_grad_(True)
    with torch.enable_grad():
        depth = depth_of(split.rear(z))
    in_z, in_output = [], []
    for down, right in _POSITIONS:
        # ∂depth/∂z of one point; the graph of the depth is kept for the next one.
        with torch.enable_grad():
            point = depth[..., int(depth.shape[-2] * down), int(depth.shape[-1] * right)].sum()
        z.grad = None
        if point.requires_grad:
            with wrap_user_errors("the gradient of the network"):
                point.backward(retain_graph=True)  # type: ignore[no-untyped-call]
        gradient = torch.zeros_like(z) if z.grad is None else z.grad
        moved = z.detach() + z.detach().std(correction=0) * gradient.sign()
        # With gradients both times: without, torch may take a kernel that rounds differently.
        with torch.enable_grad():
            changed = depth_of(split.rear(moved.requires_grad_(True))).detach() != depth.detach()
        in_output.append(_extent(changed))
        if z.ndim == 4:
            in_z.append(_extent(gradient != 0))
        width = min(_largest(in_output))
        if enough is not None and (width >= enough or 0 < width < enough / 2):
            break
    return _largest(in_z) if in_z else None, _largest(in_output)


def _extent(mask: Tensor) -> Patch:
    """Height and width of the bounding box of the true elements of (…, h, w)."""
    flat = mask.reshape(-1, *mask.shape[-2:]).any(dim=0)
    rows, columns = flat.any(dim=1).nonzero(), flat.any(dim=0).nonzero()
    if not len(rows):
        return 0, 0
    return int(rows[-1] - rows[0]) + 1, int(columns[-1] - columns[0]) + 1


def _largest(patches: list[Patch]) -> Patch:
    return max(height for height, _ in patches), max(width for _, width in patches)
