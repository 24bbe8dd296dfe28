"""How far z moves in one update: α, how it falls, how far a point's gradient reaches, and whether
every element moves by itself or whole channels do.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from pnpdepth_cli.errors import LayerError, UsageError
from pnpdepth_cli.points import SparsePoints

SCHEDULES: dict[str, Callable[[float], float]] = {
    "constant": lambda done: 1.0,
    "linear": lambda done: 1.0 - done,
}
"""The share of α that an update moves by, from the share 0 ≤ done < 1 of all updates made."""


def step_size(lr: float | str, z0: Tensor) -> float:
    """α: `lr` itself, or its per cent of the standard deviation of z_0. UsageError if no step."""
    text = str(lr).strip()
    try:
        value = float(text.removesuffix("%"))
    except ValueError:
        value = float("nan")
    if not 0 < value < float("inf"):
        raise UsageError(f"lr {lr!r} is not a step size; give a positive number, or one like 3%")
    return value / 100 * float(z0.float().std(correction=0)) if text.endswith("%") else value


def spread(gradient: Tensor, points: SparsePoints, spacings: float) -> Tensor:
    """The gradient at a map z (1, C, h, w), blurred so that cells between the points follow them.

    The blur is a Gaussian whose standard deviation is so many spacings of the points, √(HW/N):
    few points reach far, many hardly beyond their own cells. A z that is no map stays as it is.
    """
    if not spacings or gradient.ndim != 4:
        return gradient
    height, width = points.size
    sigma = spacings * (height * width / len(points)) ** 0.5
    down, across = (
        _gaussian(cells, sigma * cells / pixels, gradient)
        for cells, pixels in zip(gradient.shape[-2:], (height, width), strict=True)
    )
    return down @ gradient @ across.T


def _gaussian(cells: int, sigma: float, like: Tensor) -> Tensor:
    """(cells, cells): row i weighs the cells around i, with a sum of 1 also at the border."""
    at = torch.arange(cells, device=like.device, dtype=like.dtype)
    weights = torch.exp(-0.5 * ((at[:, None] - at) / sigma).square())
    return weights / weights.sum(dim=1, keepdim=True)


class Channels:
    """A scale and a shift of every channel of z_0, two numbers that a few points can tell.

    z_0 is a map (1, C, H, W) or tokens (1, N, C). `of` takes a gradient at z to the gradient at
    those numbers, the scales above the shifts; `spread_out` takes a change of the numbers to that
    of z: scale · (z_0 − its mean)/its deviation + shift, so that a change by 1 has a root mean
    square of 1 in z, whichever of the two it is. LayerError for a z_0 without channels.
    """

    def __init__(self, z0: Tensor) -> None:
        if z0.ndim < 3:
            raise LayerError(
                f"z of shape {tuple(z0.shape)} has no channels to scale and shift; update its"
                " elements (--parameters elements)"
            )
        inside = (1,) if z0.ndim == 3 else tuple(range(2, z0.ndim))
        centred = z0 - z0.mean(dim=inside, keepdim=True)
        deviation = centred.square().mean(dim=inside, keepdim=True).sqrt()
        self._inside = inside
        self._shape = centred / deviation.clamp_min(torch.finfo(z0.dtype).tiny)

    def of(self, gradient: Tensor) -> Tensor:
        """The gradient at scale and shift, per element of z."""
        each = (gradient * self._shape, gradient)
        return torch.cat([one.mean(dim=self._inside, keepdim=True) for one in each])

    def spread_out(self, change: Tensor) -> Tensor:
        """The change of z for a change of scale and shift."""
        scale, shift = change.tensor_split(2)
        moved: Tensor = scale * self._shape + shift
        return moved
