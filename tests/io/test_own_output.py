"""One thread is silent on stdout, the others are not."""

from __future__ import annotations

import sys
import threading

import pytest

from pnpdepth_cli.io.quiet import silent_thread


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
