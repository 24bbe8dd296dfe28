from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from pnpdepth_cli.io.quiet import SharedContext


def test_the_first_enters_and_the_last_leaves_whatever_the_order() -> None:
    states: list[str] = []

    @contextmanager
    def change() -> Iterator[None]:
        states.append("changed")
        yield
        states.append("as before")

    shared = SharedContext(change)
    first_is_in, second_is_in = threading.Event(), threading.Event()

    def first() -> None:
        with shared:
            first_is_in.set()
            second_is_in.wait()
        assert states == ["changed"]  # the second is still inside

    def second() -> None:
        first_is_in.wait()
        with shared:
            second_is_in.set()
            time.sleep(0.05)

    threads = [threading.Thread(target=work) for work in (first, second)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert states == ["changed", "as before"]


def test_an_error_inside_passes_through_and_leaves() -> None:
    states: list[str] = []

    @contextmanager
    def change() -> Iterator[None]:
        try:
            yield
        finally:
            states.append("as before")

    shared = SharedContext(change)
    with pytest.raises(ValueError, match="mine"), shared:
        raise ValueError("mine")
    assert states == ["as before"]
