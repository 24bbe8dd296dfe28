"""The size of a step and its reach, against values worked out by hand."""

from __future__ import annotations

import math

import pytest
import torch

from pnpdepth_cli.core.update_rules import SCHEDULES, blur, step_size
from pnpdepth_cli.errors import UsageError
from pnpdepth_cli.points import SparsePoints


def points(count: int, size: tuple[int, int]) -> SparsePoints:
    return SparsePoints(xy=torch.zeros(count, 2), depth=torch.ones(count), size=size)


def test_a_per_cent_step_is_that_fraction_of_the_standard_deviation_of_z0() -> None:
    z = torch.tensor([1.0, 3.0, 1.0, 3.0])  # standard deviation 1
    assert step_size("3%", z) == pytest.approx(0.03)
    assert step_size(" 3 % ", z * 10) == pytest.approx(0.3)
    assert step_size(0.01, z) == 0.01
    assert step_size("0.5", z) == 0.5


@pytest.mark.parametrize(
    "lr", [0, -1, "0%", "-3%", "x", "", "%", "nan", "inf", float("nan"), "3%%"]
)
def test_what_is_no_step_is_refused(lr: float | str) -> None:
    with pytest.raises(UsageError):
        step_size(lr, torch.ones(2))


@pytest.mark.parametrize("name", SCHEDULES)
def test_a_schedule_starts_at_the_whole_step_and_never_reaches_nothing(name: str) -> None:
    fractions = [SCHEDULES[name](k / 20) for k in range(20)]
    assert fractions[0] == 1
    assert fractions == sorted(fractions, reverse=True)
    assert fractions[-1] > 0


def test_a_linear_schedule_falls_by_the_same_amount_every_time() -> None:
    assert [SCHEDULES["linear"](k / 4) for k in range(4)] == [1, 0.75, 0.5, 0.25]


def test_no_blur_and_a_z_that_is_no_map_leave_the_gradient_itself() -> None:
    gradient = torch.randn(1, 3, 5, 7)
    assert blur(gradient, points(4, (50, 70)), 0.0) is gradient
    tokens = torch.randn(1, 35, 3)
    assert blur(tokens, points(4, (50, 70)), 2.0) is tokens


def test_the_reach_is_a_gaussian_of_so_many_spacings_of_the_points() -> None:
    # 4 points on 40 × 80 pixels are √800 pixels apart; a cell is 4 pixels high and 2 wide
    gradient = torch.zeros(1, 1, 10, 40)
    gradient[0, 0, 5, 20] = 1
    result = blur(gradient, points(4, (40, 80)), 0.25)[0, 0]

    def weight(cell: int, cells: int, of: int, sigma: float) -> float:
        """What cell `of` weighs in the mean that `cell` becomes."""
        weights = [math.exp(-0.5 * ((cell - other) / sigma) ** 2) for other in range(cells)]
        return weights[of] / sum(weights)

    down, across = 0.25 * math.sqrt(800) / 4, 0.25 * math.sqrt(800) / 2
    for row, column in ((5, 20), (4, 20), (9, 23), (0, 0), (7, 39)):
        expected = weight(row, 10, 5, down) * weight(column, 40, 20, across)
        assert float(result[row, column]) == pytest.approx(expected, rel=1e-4)
