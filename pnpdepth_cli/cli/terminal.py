"""Lines, JSON and progress on a terminal."""

from __future__ import annotations

import contextlib
import json
import re
import signal
import sys
import time
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

import click

from pnpdepth_cli.commands.requests.refine_request import RefineRequest
from pnpdepth_cli.settings import Settings, flag_of, options_of

if TYPE_CHECKING:
    from tqdm import tqdm

_IN_BACKTICKS = re.compile(r"`(\w+)`")
_FLAGS = {
    field.name: flag_of(field) for field in (*options_of(Settings), *options_of(RefineRequest))
}
"""How the command line spells each setting."""
_LINE_EVERY_S = 60.0
"""Seconds between lines of progress where there is no terminal."""
_SHOWN_AFTER_S = 1.0
"""Seconds after which a bar is shown."""
INTERRUPTED = 128 + signal.SIGINT
"""The exit code after Ctrl-C."""


def printable(text: object) -> str:
    """Returns the text with unprintable characters as escapes, and `name` of an option as --name.

    Messages that the Python API shares have the names of settings in backticks.
    """
    spelt = _IN_BACKTICKS.sub(lambda match: _FLAGS.get(match[1], match[0]), str(text))
    characters = [
        character if character.isprintable() else character.encode("unicode_escape").decode("ascii")
        for character in spelt
    ]
    return "".join(characters)


def say(text: object) -> None:
    """Prints a line on stderr; work goes on where nobody reads it."""
    with contextlib.suppress(OSError):
        click.echo(printable(text), err=True)


def print_json(value: object) -> None:
    """Prints a value, of dictionaries, lists, texts and numbers, as JSON on stdout."""
    click.echo(json.dumps(value, indent=2))


@contextlib.contextmanager
def progress_bar(title: str, unit: str) -> Iterator[Callable[[int, int], None]]:
    """Yields `show(done, total)`, which draws a bar for work of more than a second.

    Not on a terminal, it prints a line per minute. The time counts from the first call of `show`.

    Args:
        title: Name of the work, in front of the bar.
        unit: Noun of what is counted, such as `frame`.
    """
    bar: tqdm[None] | None = None
    began = printed_at = 0.0

    def show(done: int, total: int) -> None:
        """Draws the bar, or prints a line, that so many of all are done."""
        nonlocal bar, began, printed_at
        from tqdm import tqdm

        # The bar is made when there is something to show.
        now = time.monotonic()
        if bar is None:
            tqdm.monitor_interval = 0  # without its thread, image libraries can be silenced
            bar = tqdm(
                desc=title,
                unit=unit,
                total=total,
                disable=None,  # draws nothing where stderr is no terminal
                dynamic_ncols=True,
                leave=False,  # the bar is gone at the end, and its line is free
                delay=_SHOWN_AFTER_S,
            )
            began = printed_at = now
        # Where there is no terminal, a line now and then.
        if bar.disable and done and now - printed_at >= _LINE_EVERY_S:
            printed_at = now
            say(tqdm.format_meter(done, total, now - began, 0, title, unit=unit))
        bar.update(done - bar.n)

    try:
        yield show
    finally:
        if bar is not None:
            bar.close()


def say_above_bar(text: str) -> None:
    """Prints a line on stderr, above a progress bar."""
    from tqdm import tqdm

    tqdm.write(printable(text), file=sys.stderr)
