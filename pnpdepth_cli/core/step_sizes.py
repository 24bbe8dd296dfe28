"""How z moves in one update: step size, schedule, blur of the gradient, and what is updated."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from pnpdepth_cli.errors import LayerError, UsageError
from pnpdepth_cli.points import SparsePoints

SCHEDULES: dict[str, Callable[[float], float]] = {
    "constant": lambda done: 1.0,
    "linear": lambda done: 1.0 - done,
    "cosine": lambda done: 0.5 * (1.0 + math.cos(math.pi * done)),
}
"""Factor of α at each update, from the fraction 0 ≤ done < 1 of the updates already made."""


def step_size(lr: float | str, z0: Tensor) -> float:
    """Returns α as a number.

    Args:
        lr: A positive number, or a text such as "3%": that percentage of the standard deviation
            of z_0.
        z0: z_0, of any shape.

    Raises:
        UsageError: `lr` is neither.
    """
    text = str(lr).strip()
    try:
        value = float(text.removesuffix("%"))
    except ValueError:
        value = float("nan")
    if not 0 < value < float("inf"):
        raise UsageError(f"lr {lr!r} is not a step size; give a positive number, or one like 3%")
    return value / 100 * float(z0.float().std(correction=0)) if text.endswith("%") else value


def blurred(gradient: Tensor, points: SparsePoints, spacings: float) -> Tensor:
    """Returns the gradient convolved with a Gaussian, so that it also reaches between the points.

    The Gaussian's standard deviation is proportional to the mean spacing of the points: few points
    reach far, many points hardly beyond their own cells.

    Args:
        gradient: (1, C, h, w) at z. Any other shape is returned unchanged.
        points: The N sparse points of the frame of H × W pixels.
        spacings: Standard deviation in units of √(HW/N) pixels; 0 returns the gradient unchanged.
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
    """(cells, cells): row i has the weights around cell i; every row sums to 1, also at borders."""
    at = torch.arange(cells, device=like.device, dtype=like.dtype)
    weights = torch.exp(-0.5 * ((at[:, None] - at) / sigma).square())
    return weights / weights.sum(dim=1, keepdim=True)


class Channels:
    """A scale and a shift of every channel of z_0, to be updated instead of the elements of z.

    z = z_0 + scale · (z_0 − mean)/std + shift, per channel. A change of scale or shift by 1 changes
    z by a root mean square of 1.

    Args:
        z0: A map (1, C, H, W) or tokens (1, N, C).

    Raises:
        LayerError: z_0 has another shape.
    """

    def __init__(self, z0: Tensor) -> None:
        if z0.ndim < 3:
            raise LayerError(
                f"z of shape {tuple(z0.shape)} has no channels to scale and shift; update its"
                " elements (--set parameters=elements)"
            )
        self._dims = (1,) if z0.ndim == 3 else tuple(range(2, z0.ndim))
        centred = z0 - z0.mean(dim=self._dims, keepdim=True)
        deviation = centred.square().mean(dim=self._dims, keepdim=True).sqrt()
        self._standardised = centred / deviation.clamp_min(torch.finfo(z0.dtype).tiny)

    def gradient(self, gradient_at_z: Tensor) -> Tensor:
        """Returns the gradient at scale and shift, stacked along axis 0, per element of z."""
        gradients = (gradient_at_z * self._standardised, gradient_at_z)
        return torch.cat([one.mean(dim=self._dims, keepdim=True) for one in gradients])

    def change_of_z(self, change: Tensor) -> Tensor:
        """Returns the change of z for a change of scale and shift, stacked along axis 0."""
        scale, shift = change.tensor_split(2)
        change_of_z: Tensor = scale * self._standardised + shift
        return change_of_z
