"""One thread is silent on stdout, the others are not; shared state comes back."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
from pnpdepth_cli.io.quiet import SharedContext, silent_thread


def test_only_the_thread_inside_is_silent(capsys: pytest.CaptureFixture[str]) -> None:
    before = sys.stdout
    inside, done = threading.Event(), threading.Event()

    def work() -> None:
        with silent_thread():
            sys.stdout.write("dropped\n")
            inside.set()
            done.wait(10)
            sys.stdout.write("dropped\n")
        sys.stdout.write("said afterwards\n")

    thread = threading.Thread(target=work)
    thread.start()
    assert inside.wait(10)
    sys.stdout.write("said meanwhile\n")
    done.set()
    thread.join()
    assert capsys.readouterr().out == "said meanwhile\nsaid afterwards\n"
    assert sys.stdout is before


def test_the_stream_comes_back_after_an_error() -> None:
    before = sys.stdout

    def fail() -> None:
        with silent_thread():
            assert sys.stdout.encoding == before.encoding
            raise ValueError("inside")

    with pytest.raises(ValueError, match="inside"):
        fail()
    assert sys.stdout is before


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
