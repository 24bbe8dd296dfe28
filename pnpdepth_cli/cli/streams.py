"""Text for a terminal, and stdout and stderr that may be closed, full or cut off."""

from __future__ import annotations

import contextlib
import errno
import io
import json
import os
import signal
import sys
from typing import Any, TextIO

import click

INTERRUPTED = 128 + signal.SIGINT
"""The exit code after Ctrl-C."""
_LONGEST = 2000


def printable(text: object) -> str:
    """Returns the text with unprintable characters, such as line breaks, as escapes."""
    return "".join(
        c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in str(text)
    )


def say(text: object) -> None:
    """Prints a line on stderr."""
    click.echo(printable(text), err=True)


def print_json(value: Any) -> None:
    """Prints a value of JSON's own types on stdout."""
    click.echo(json.dumps(value, indent=2))


def shortened(text: str) -> str:
    """Returns the text, without its middle where it is longer than 2,000 characters."""
    half = _LONGEST // 2
    return text if len(text) <= _LONGEST else f"{text[:half]} … {text[-half:]}"


class StdoutError(Exception):
    """stdout cannot be written to; `reason` is the operating system's error."""

    def __init__(self, reason: OSError) -> None:
        super().__init__(f"stdout cannot be written to: {reason.strerror}")
        self.reason = reason


class _Raw(io.RawIOBase):
    """The raw stream of stdout or stderr, with errors that differ from those of files.

    A stream that is None was closed before the program started.
    """

    def __init__(self, stream: Any, *, ignore_errors: bool) -> None:
        self._stream, self.ignore_errors = stream, ignore_errors

    def writable(self) -> bool:
        return True

    def fileno(self) -> int:
        return 1 if self._stream is None else int(self._stream.fileno())

    def isatty(self) -> bool:
        return self._stream is not None and bool(self._stream.isatty())

    def write(self, data: Any) -> int:
        try:
            if self._stream is None:
                raise OSError(errno.EBADF, "it is closed")
            count = self._stream.write(data)
        except OSError as error:
            if not self.ignore_errors:
                raise StdoutError(error) from None
            return len(data)
        return len(data) if count is None else int(count)


def guard_streams() -> None:
    """Makes errors of stdout a StdoutError, and ignores errors of stderr.

    A closed stdout or stderr gets a descriptor first, so that no result file takes its number.
    Streams that are not the process's own, as in tests, stay as they are.
    """
    closed = _open_closed_descriptors()
    if 1 in closed or sys.stdout is None:
        sys.stdout = _text(_Raw(None, ignore_errors=False), None)
    elif sys.stdout is sys.__stdout__ and isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout = _text(_Raw(_raw_of(sys.stdout), ignore_errors=False), sys.stdout)
    if 2 in closed or sys.stderr is None:
        sys.stderr = open(os.devnull, "w", encoding="utf-8")  # noqa: PTH123, SIM115
    elif sys.stderr is sys.__stderr__ and isinstance(sys.stderr, io.TextIOWrapper):
        sys.stderr = _text(_Raw(_raw_of(sys.stderr), ignore_errors=True), sys.stderr)
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")  # a terminal without σ still shows the rest


def drop_stdout() -> None:
    """Discards what is still to be written to stdout."""
    raw = getattr(getattr(sys.stdout, "buffer", None), "raw", None)
    if isinstance(raw, _Raw):
        raw.ignore_errors = True
    sys.stdout = open(os.devnull, "w", encoding="utf-8")  # noqa: PTH123, SIM115


def _open_closed_descriptors() -> set[int]:
    closed = set()
    for descriptor in (0, 1, 2):
        try:
            os.fstat(descriptor)
        except OSError:
            closed.add(descriptor)
            with contextlib.suppress(OSError):
                os.open(os.devnull, os.O_RDWR)  # takes the lowest free number, which is this one
    return closed


def _raw_of(stream: io.TextIOWrapper) -> Any:
    return getattr(stream.buffer, "raw", stream.buffer)


def _text(raw: io.RawIOBase, like: TextIO | None) -> io.TextIOWrapper:
    """Returns a text stream over `raw` with the encoding and buffering of `like`."""
    return io.TextIOWrapper(
        io.BufferedWriter(raw),
        encoding=like.encoding if like is not None else "utf-8",
        errors=like.errors if like is not None else "replace",
        line_buffering=like is not None and (like is sys.__stderr__ or like.isatty()),
    )
