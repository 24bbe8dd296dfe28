from __future__ import annotations

import time
from itertools import count

import pytest

from pnpdepth_cli.commands.shared.pipeline import in_order


def test_results_come_in_order_few_items_are_taken_ahead_and_an_error_ends_the_work() -> None:
    def work(number: int) -> int:
        time.sleep(0.02 if number == 1 else 0)
        if number == 21:
            raise ValueError("not this one")
        return number

    taken = count(1)
    results = in_order(work, taken, 3)
    assert [next(results) for _ in range(20)] == list(range(1, 21))
    with pytest.raises(ValueError, match="not this one"):
        next(results)
    assert next(taken) <= 26
