"""One thread is silent on stdout, the others are not; shared state comes back."""

from __future__ import annotations

import sys
import threading
import warnings
from contextlib import ExitStack

import PIL.Image
import pytest

from pnpdepth_cli.io.decoding import silence


def test_only_the_thread_inside_is_silent(capsys: pytest.CaptureFixture[str]) -> None:
    before = sys.stdout
    inside, done = threading.Event(), threading.Event()

    def work() -> None:
        with silence():
            sys.stdout.write("dropped\n")
            inside.set()
            done.wait(10)
            sys.stdout.write("dropped\n")
        sys.stdout.write("said afterwards\n")

    thread = threading.Thread(target=work)
    thread.start()
    assert inside.wait(10)
    sys.stdout.write("said meanwhile\n")
    with silence():
        sys.stdout.write("dropped\n")
    done.set()
    thread.join()
    assert capsys.readouterr().out == "said meanwhile\nsaid afterwards\n"
    assert sys.stdout is before


def test_the_state_comes_back_after_an_error_and_in_whatever_order_they_leave() -> None:
    before, limit = sys.stdout, PIL.Image.MAX_IMAGE_PIXELS
    first, second = ExitStack(), ExitStack()
    first.enter_context(silence())
    second.enter_context(silence())
    assert PIL.Image.MAX_IMAGE_PIXELS is None
    first.close()
    assert PIL.Image.MAX_IMAGE_PIXELS is None  # the second is still inside
    assert sys.stdout.encoding == before.encoding

    def fail() -> None:
        with second:
            warnings.warn("dropped", UserWarning, stacklevel=1)
            raise ValueError("inside")

    with pytest.raises(ValueError, match="inside"):
        fail()
    assert (sys.stdout, PIL.Image.MAX_IMAGE_PIXELS) == (before, limit)
