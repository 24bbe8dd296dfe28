"""Functions that remember their last results."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from pnpdepth_cli.completion import remembered as module
from pnpdepth_cli.completion.remembered import remembered

calls: list[int] = []


@remembered(2)
def total(xy: NDArray[np.float64], factor: int) -> float:
    calls.append(len(xy))
    return float(xy.sum()) * factor


@pytest.fixture(autouse=True)
def no_calls() -> None:
    calls.clear()


def points(seed: int, count: int = 5) -> NDArray[np.float64]:
    return np.random.default_rng(seed).random((count, 2))


def test_equal_coordinates_are_computed_once() -> None:
    assert total(points(0), 2) == total(points(0), 2) == points(0).sum() * 2
    assert len(calls) == 1


def test_other_coordinates_other_numbers_and_forgotten_results_are_computed() -> None:
    assert total(points(1), 1) != total(points(2), 1)
    assert total(points(2), 3) == pytest.approx(3 * total(points(2), 1))
    assert len(calls) == 3
    total(points(1), 1)  # only the last two are remembered
    assert len(calls) == 4


def test_many_coordinates_are_not_remembered(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MOST_REMEMBERED", 5)
    for _ in range(2):
        total(points(3, count=6), 1)
    assert len(calls) == 2


def test_the_function_cannot_change_what_it_is_known_by() -> None:
    @remembered(1)
    def spoil(xy: NDArray[np.float64]) -> None:
        xy[0] = 0

    with pytest.raises(ValueError, match="read-only"):
        spoil(points(4))
