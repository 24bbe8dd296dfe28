from __future__ import annotations

from math import inf, isfinite, log
from pathlib import Path

import pytest
import torch

from pnpdepth_cli.choices import LOSSES
from pnpdepth_cli.core.losses import MIN_DEPTH, checked_loss
from pnpdepth_cli.errors import ModelError

PREDICTED = torch.tensor([1.0, 2.0, 4.0, 10.0])
TRUE = torch.tensor([1.0, 2.5, 2.0, 5.0])
# errors 0, ½, 2, 5; c of berhu = 1, so ½ is linear there and 2 and 5 are quadratic
C = 1.4826 * log(2.5 / 2)
BY_HAND = {
    "l1": 7.5 / 4,
    "l2": (0.25 + 4 + 25) / 4,
    "huber": (0.5 * 0.25 + 1.5 + 4.5) / 4,
    "berhu": (0.5 + (4 + 1) / 2 + (25 + 1) / 2) / 4,
    # the lower of the two middle errors, log 2.5/2, sets c
    "cauchy": C * (log(1 + 1 / 1.4826**2) + 2 * log(1 + (log(2) / C) ** 2)) / 4,
}


@pytest.mark.parametrize("name", LOSSES)
def test_a_loss_has_the_value_worked_out_by_hand(name: str) -> None:
    assert float(LOSSES[name](PREDICTED, TRUE)) == pytest.approx(BY_HAND[name], rel=1e-6)


def test_a_loss_of_a_file_that_gives_no_scalar_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "own.py"
    file.write_text("def loss(predicted, true):\n    return predicted - true\n")
    with pytest.raises(ModelError):
        checked_loss(str(file))(TRUE, TRUE)


@pytest.mark.parametrize("name", LOSSES)
@pytest.mark.parametrize("value", [-5.0, 0.0, MIN_DEPTH / 2, 1e30, 1e-30])
def test_the_gradient_of_any_finite_prediction_points_to_the_truth(name: str, value: float) -> None:
    predicted = torch.tensor([value, 1.0], requires_grad=True)
    loss = LOSSES[name](predicted, torch.tensor([2.0, 1.5]))
    gradient = torch.autograd.grad(loss, predicted)[0]
    assert float(loss) > 0
    assert (value - 2) * float(gradient[0]) >= 0
    assert float(gradient[1]) <= 0


@pytest.mark.parametrize("name", LOSSES)
@pytest.mark.parametrize("value", [inf, float("nan")])
def test_a_prediction_that_is_not_finite_is_seen_in_the_loss(name: str, value: float) -> None:
    assert not isfinite(LOSSES[name](torch.tensor([value, 1.0]), torch.tensor([2.0, 1.5])))
