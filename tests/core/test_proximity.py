"""The proximity loss against values worked out by hand."""

from __future__ import annotations

from math import log

import pytest
import torch

from pnpdepth_cli.core.losses import MIN_DEPTH
from pnpdepth_cli.core.proximity import proximity_loss


def test_it_is_the_mean_squared_change_of_log_depth() -> None:
    loss = proximity_loss(torch.tensor([2.0, 3.0, 8.0]), torch.tensor([1.0, 3.0, 2.0]))
    assert float(loss) == pytest.approx((log(2) ** 2 + log(4) ** 2) / 3)


def test_depth_that_is_not_positive_is_read_as_the_least_depth() -> None:
    loss = proximity_loss(torch.tensor([-1.0, 0.0]), torch.tensor([MIN_DEPTH, MIN_DEPTH / 2]))
    assert float(loss) == 0
