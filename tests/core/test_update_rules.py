"""U of equation 3, against torch.optim where it has the same rule."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from pnpdepth_cli.choices import UPDATES
from pnpdepth_cli.core import update_rules
from pnpdepth_cli.core.update_rules import (
    Update,
    adam,
    lbfgs,
    momentum,
    normalised,
    sgd,
    sign,
)


def stepped(update: Update, steps: int = 20, lr: float = 0.1) -> Tensor:
    z = torch.linspace(-2, 3, 7)
    for _ in range(steps):
        z = z - lr * update(gradient_of(z))
    return z


def gradient_of(z: Tensor) -> Tensor:
    """Of Σ (z² − 1)² / 4, which has minima at ±1."""
    return (z * z - 1) * z


def optimised(make: Callable[[list[Tensor]], torch.optim.Optimizer], steps: int = 20) -> Tensor:
    z = torch.linspace(-2, 3, 7).requires_grad_(True)
    optimiser = make([z])
    for _ in range(steps):
        z.grad = gradient_of(z.detach())
        optimiser.step()
    return z.detach()


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
    torch.testing.assert_close(stepped(update()), optimised(make), rtol=1e-5, atol=1e-6)


def test_the_sign_of_nothing_is_nothing() -> None:
    assert sign()(torch.tensor([-3.0, 0.0, -0.0, 1e-30])).tolist() == [-1, 0, 0, 1]


@pytest.mark.parametrize("name", UPDATES)
def test_where_no_gradient_ever_comes_nothing_moves(name: str) -> None:
    update = UPDATES[name]()
    for _ in range(4):
        assert update(torch.tensor([0.0, 5.0]))[0] == 0


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
def test_a_normalised_gradient_keeps_its_direction_and_has_a_root_mean_square_of_one(
    scale: float,
) -> None:
    update = normalised()(torch.tensor([[1.0, -7.0], [0.0, 5.0]]) * scale)
    assert update.flatten().tolist() == pytest.approx([x / 75**0.5 * 2 for x in (1, -7, 0, 5)])
    assert normalised()(torch.zeros(3)).tolist() == [0, 0, 0]


@pytest.mark.parametrize("alpha", [0.05, 1.0, 3.0])
def test_l_bfgs_moves_as_dense_bfgs_does_whatever_the_step(
    alpha: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(update_rules, "MAX_RMS", 1e6)
    torch.manual_seed(0)
    curved = torch.randn(6, 6, dtype=torch.float64)
    curved = curved @ curved.T + torch.eye(6, dtype=torch.float64)
    z, update = torch.randn(6, dtype=torch.float64), lbfgs()
    steps: list[Tensor] = []
    changes: list[Tensor] = []
    for count in range(6):
        gradient = curved @ z
        moved = -alpha * update(gradient)
        if count:
            torch.testing.assert_close(moved, -dense_bfgs(steps, changes) @ gradient)
        steps.append(moved)
        changes.append(curved @ (z + moved) - gradient)
        z = z + moved


def dense_bfgs(steps: list[Tensor], changes: list[Tensor]) -> Tensor:
    """The inverse Hessian by Nocedal & Wright's equations 6.17 and 6.20."""
    one = torch.eye(len(steps[0]), dtype=torch.float64)
    inverse = (steps[-1] @ changes[-1]) / (changes[-1] @ changes[-1]) * one
    for s, y in zip(steps, changes, strict=True):
        left = one - torch.outer(s, y) / (s @ y)
        inverse = left @ inverse @ left.T + torch.outer(s, s) / (s @ y)
    return inverse


def test_l_bfgs_takes_no_direction_from_a_loss_that_curves_down_and_none_that_is_too_long() -> None:
    update = lbfgs()
    first = update(torch.tensor([1.0, 1.0]))
    assert torch.equal(first, normalised()(torch.tensor([1.0, 1.0])))
    steeper = torch.tensor([2.0, 2.0])  # z went down by the first direction and it got steeper
    assert torch.equal(update(steeper), normalised()(steeper))
    nearly_flat = torch.tensor([1.999, 1.999])
    assert update(nearly_flat).tolist() == pytest.approx([10, 10])
