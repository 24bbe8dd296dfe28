"""Text for a terminal."""

from __future__ import annotations

import contextlib
import json
import signal
from typing import Any

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
    """Prints a line on stderr; work goes on where nobody reads it."""
    with contextlib.suppress(OSError):
        click.echo(printable(text), err=True)


def print_json(value: Any) -> None:
    """Prints a value of JSON's own types on stdout."""
    click.echo(json.dumps(value, indent=2))


def shorten(text: str) -> str:
    """Returns the text, without its middle where it is longer than 2,000 characters."""
    half = _LONGEST // 2
    return text if len(text) <= _LONGEST else f"{text[:half]} … {text[-half:]}"
