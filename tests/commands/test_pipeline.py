from __future__ import annotations

import time
from itertools import count

import pytest

from pnpdepth_cli.commands.pipeline import in_order


def test_results_come_in_order_and_few_items_are_taken_ahead() -> None:
    def slow_at_first(number: int) -> int:
        time.sleep(0.02 if number == 1 else 0)
        return number

    taken = count(1)
    results = in_order(slow_at_first, taken, 3)
    assert [next(results) for _ in range(20)] == list(range(1, 21))
    results.close()
    assert next(taken) <= 25


def test_an_error_comes_out_and_ends_the_work() -> None:
    done: list[int] = []

    def work(number: int) -> None:
        if number == 3:
            raise ValueError("three")
        done.append(number)

    with pytest.raises(ValueError, match="three"):
        list(in_order(work, range(1000), 2))
    assert len(done) < 12
