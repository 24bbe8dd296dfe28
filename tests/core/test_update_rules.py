"""U of equation 3 against torch.optim, and the size and reach of a step against values by hand."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from torch import Tensor

from pnpdepth_cli.choices import UPDATES
from pnpdepth_cli.core.update_rules import Update, adam, blur, momentum, normalised, sgd, step_size
from pnpdepth_cli.points import SparsePoints


def gradient_of(z: Tensor) -> Tensor:
    """Of Σ (z² − 1)² / 4, which has minima at ±1."""
    return (z * z - 1) * z


@pytest.mark.parametrize(
    ("update", "make"),
    [
        (sgd, lambda p: torch.optim.SGD(p, lr=0.1)),
        (momentum, lambda p: torch.optim.SGD(p, lr=0.1, momentum=0.9)),
        (adam, lambda p: torch.optim.Adam(p, lr=0.1, eps=1e-12)),
        (lambda: adam(0.5, 0.9, 1e-8), lambda p: torch.optim.Adam(p, 0.1, (0.5, 0.9), 1e-8)),
    ],
)
def test_an_update_is_that_of_torch_optim(
    update: Callable[[], Update], make: Callable[[list[Tensor]], torch.optim.Optimizer]
) -> None:
    own = update()
    z = torch.linspace(-2, 3, 7)
    theirs = torch.linspace(-2, 3, 7)
    optimiser = make([theirs])
    for _ in range(20):
        z = z - 0.1 * own(gradient_of(z))
        theirs.grad = gradient_of(theirs)
        optimiser.step()
    torch.testing.assert_close(z, theirs, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("name", UPDATES)
def test_an_update_changes_neither_its_gradient_nor_a_second_run(name: str) -> None:
    gradient = torch.tensor([1.0, -2.0])
    runs = []
    for _ in range(2):
        update = UPDATES[name]()
        runs.append([update(gradient * k) for k in (1, 2, 3)])
    assert torch.equal(gradient, torch.tensor([1.0, -2.0]))
    assert all(torch.equal(a, b) for a, b in zip(*runs, strict=True))


@pytest.mark.parametrize("scale", [1.0, 1e-30, 1e30])
def test_a_normalised_gradient_keeps_its_direction_and_has_an_rms_of_one(scale: float) -> None:
    update = normalised()(torch.tensor([[1.0, -7.0], [0.0, 5.0]]) * scale)
    assert update.flatten().tolist() == pytest.approx([x / 75**0.5 * 2 for x in (1, -7, 0, 5)])
    assert normalised()(torch.zeros(3)).tolist() == [0, 0, 0]


@pytest.mark.parametrize(("lr", "step"), [("3%", 0.3), (" 3 % ", 0.3), (0.01, 0.01), ("0.5", 0.5)])
def test_a_per_cent_step_is_a_fraction_of_the_deviation_of_z0(lr: float | str, step: float) -> None:
    z = torch.tensor([10.0, 30.0, 10.0, 30.0])  # standard deviation 10
    assert step_size(lr, z) == pytest.approx(step)


POINTS = SparsePoints(xy=torch.zeros(4, 2), depth=torch.ones(4), size=(40, 80))


def test_no_blur_and_a_z_that_is_no_map_leave_the_gradient_itself() -> None:
    gradient = torch.randn(1, 3, 5, 7)
    tokens = torch.randn(1, 35, 3)
    assert blur(gradient, POINTS, 0.0) is gradient
    assert blur(tokens, POINTS, 2.0) is tokens


def test_the_reach_is_a_gaussian_of_so_many_spacings_of_the_points() -> None:
    # 4 points on 40 × 80 pixels are √800 pixels apart; a cell is 4 pixels high and 2 wide
    gradient = torch.zeros(1, 1, 10, 40)
    gradient[0, 0, 5, 20] = 1

    def weights(cells: int, of: int, sigma: float) -> np.ndarray:
        """What cell `of` weighs in the mean that each of the cells becomes."""
        weight = np.exp(-0.5 * (np.subtract.outer(range(cells), range(cells)) / sigma) ** 2)
        return weight[:, of] / weight.sum(axis=1)

    down = 0.25 * math.sqrt(800) / 4
    across = 0.25 * math.sqrt(800) / 2
    expected = np.outer(weights(10, 5, down), weights(40, 20, across))
    np.testing.assert_allclose(blur(gradient, POINTS, 0.25)[0, 0], expected, rtol=1e-4, atol=1e-9)
