"""Where the process starts and ends: Ctrl-C at any moment is one line and code 130."""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import sys


def main() -> None:
    """Runs the command line with the process's arguments and exits."""
    code = 128 + signal.SIGINT
    _keep_freed_memory()
    try:
        from pnpdepth_cli.cli.main import run

        code = run(sys.argv[1:])
    except BaseException as error:
        if not _is_interrupt(error):
            raise
        with contextlib.suppress(OSError):
            os.write(2, b"pnpdepth: interrupted\n")
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the results are written; end with their code
    sys.exit(code)


def _is_interrupt(error: BaseException | None) -> bool:
    """Whether it is a Ctrl-C, or came of one: before Python 3.12, a class body turns it into a
    RuntimeError.
    """
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__
    return error is not None


def _keep_freed_memory() -> None:
    """Makes malloc of glibc reuse the memory of large arrays.

    By default it is returned to the kernel, which clears its pages before each use: a fifth of the
    time of a network's passes.
    """
    trim_threshold, mmap_threshold = -1, -3  # of malloc.h
    with contextlib.suppress(AttributeError, OSError, TypeError):  # another C library
        mallopt = ctypes.CDLL(None).mallopt
        mallopt(trim_threshold, 1 << 30)
        mallopt(mmap_threshold, 1 << 30)
