"""U and α of equation 3: from the gradient at z to the direction and the size of its update.

A function of `pnpdepth_cli.choices.UPDATES` makes a new rule. A rule is called with the gradients
of one refinement, in order, and returns a direction of the same shape; z moves by −α × direction.
The gradient may be blurred before.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from pnpdepth_cli.points import SparsePoints

Update = Callable[[Tensor], Tensor]


def sign() -> Update:
    """Returns the rule g → sign(g), the paper's (after Kurakin et al. 2017)."""
    return torch.sign


def sgd() -> Update:
    """Returns the rule g → g: gradient descent."""
    return lambda gradient: gradient


def normalised() -> Update:
    """Returns the rule g → g / rms(g); an all-zero gradient stays zero.

    Like the sign, it makes the step independent of the loss's unit and of the number of points.
    Unlike the sign, it keeps the relative sizes of the elements: those with little influence move
    little.
    """

    def update(gradient: Tensor) -> Tensor:
        """The gradient, of any shape, divided by the root of its mean square."""
        # Divided by the largest element first: squares of tiny gradients would underflow. A zero
        # gradient is divided by `tiny`, so that it stays zero.
        largest = gradient.abs().max().clamp_min(torch.finfo(gradient.dtype).tiny)
        relative = gradient / largest
        return relative / relative.square().mean().sqrt().clamp_min(torch.finfo().tiny)

    return update


def momentum(decay: float = 0.9) -> Update:
    """Returns the rule v ← decay·v + g, whose direction is v.

    Heavy-ball momentum (Polyak 1964), without damping, as in torch.optim.SGD.
    """
    velocity: Tensor | None = None

    def update(gradient: Tensor) -> Tensor:
        """The velocity v after this gradient, of the same shape."""
        nonlocal velocity
        velocity = gradient if velocity is None else decay * velocity + gradient
        return velocity

    return update


def adam(beta1: float = 0.9, beta2: float = 0.999, eps: float = 1e-12) -> Update:
    """Returns Adam's rule with bias correction (Kingma & Ba 2014).

    Elements whose gradient is always zero do not move.

    Args:
        beta1: Decay of the mean of the gradients.
        beta2: Decay of the mean of their squares.
        eps: Summand of the denominator. It is smaller than the common 1e-8, because the gradient of
            a mean over many points is tiny at most elements of z and 1e-8 would suppress them.
    """
    mean: Tensor | None = None
    mean_square: Tensor | None = None
    step = 0

    def update(gradient: Tensor) -> Tensor:
        """The unbiased mean gradient over the root of the unbiased mean square, elementwise."""
        nonlocal mean, mean_square, step
        step += 1
        if mean is None or mean_square is None:
            mean = torch.zeros_like(gradient)
            mean_square = torch.zeros_like(gradient)
        mean = (1 - beta1) * gradient + beta1 * mean
        mean_square = (1 - beta2) * gradient.square() + beta2 * mean_square
        # Both began at 0, which the division takes out (bias correction).
        unbiased_mean = mean / (1 - beta1**step)
        unbiased_square = mean_square / (1 - beta2**step)
        return unbiased_mean / (unbiased_square.sqrt() + eps)

    return update


def constant(done: float) -> float:
    """Returns 1, the factor of α after any fraction 0 ≤ done < 1 of the updates (the paper's)."""
    return 1.0


def linear(done: float) -> float:
    """Returns the factor of α that falls from 1 to 0 with the fraction 0 ≤ done < 1 of updates."""
    return 1.0 - done


def step_size(lr: float | str, z0: Tensor) -> float:
    """Returns α as a number.

    Args:
        lr: A positive number, or a text such as "3%": that percentage of the standard deviation
            of z_0.
        z0: z_0, of any shape.
    """
    text = str(lr).strip()
    number = float(text.removesuffix("%"))
    if not text.endswith("%"):
        return number
    return number / 100 * float(z0.float().std(correction=0))


def blur(gradient: Tensor, points: SparsePoints, spacings: float) -> Tensor:
    """Returns the gradient convolved with a Gaussian, so that it also reaches between the points.

    The Gaussian's standard deviation is proportional to the mean spacing of the points: few points
    reach far, many points hardly beyond their own cells.

    Args:
        gradient: Gradient (1, C, h, w) at z. Another shape, which has no rows and columns to blur
            along, is returned unchanged.
        points: The N sparse points of an image of H × W pixels.
        spacings: Standard deviation in units of √(HW/N) pixels; 0 returns the gradient unchanged.
    """
    if not spacings or gradient.ndim != 4:
        return gradient
    height, width = points.size
    sigma_px = spacings * (height * width / len(points)) ** 0.5
    rows, columns = gradient.shape[-2:]
    # z has fewer rows and columns than the image, so that sigma is shorter in its cells.
    down = _gaussian(rows, sigma_px * rows / height, gradient)
    across = _gaussian(columns, sigma_px * columns / width, gradient)
    return down @ gradient @ across.T


def _gaussian(cells: int, sigma: float, like: Tensor) -> Tensor:
    """The matrix (cells, cells) that convolves a row of cells with a Gaussian.

    Its row i has the weights around cell i. Every row sums to 1, also at borders.

    Args:
        cells: Number of cells in the row.
        sigma: Standard deviation in cells.
        like: Tensor whose type and device the matrix has.
    """
    index = torch.arange(cells, device=like.device, dtype=like.dtype)
    weights = torch.exp(-0.5 * ((index[:, None] - index) / sigma).square())
    return weights / weights.sum(dim=1, keepdim=True)
