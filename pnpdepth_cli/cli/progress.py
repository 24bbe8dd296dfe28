"""How far a batch is: a bar on a terminal, a line a minute elsewhere."""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping
from types import TracebackType
from typing import TYPE_CHECKING, Any

import click

from pnpdepth_cli.cli.printable import printable

if TYPE_CHECKING:
    from tqdm import tqdm

_LINE_EVERY_S = 60.0


class BatchProgress:
    """Tells on stderr what happens; done, failed, to_do: how many frames, or what `unit` says."""

    def __init__(self, name: str = "batch", unit: str = "frame") -> None:
        self._name, self._unit = name, unit
        self.done = self.to_do = self.failed = 0
        self._bar: tqdm[Any] | None = None

    def __enter__(self) -> BatchProgress:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._bar is not None:
            self._bar.close()

    def say(self, text: str) -> None:
        """A line on stderr, above the bar."""
        line = printable(text)
        if self._bar is None:
            click.echo(line, err=True)
        else:
            self._bar.write(line, file=sys.stderr)

    def begin(self, to_do: int) -> None:
        """So many frames are to be done from now on."""
        self.to_do = to_do
        self._began = self._told = time.monotonic()
        if sys.stderr.isatty():
            from tqdm import tqdm

            self._bar = tqdm(total=to_do, desc=self._name, unit=self._unit, dynamic_ncols=True)

    def frame(self, row: Mapping[str, Any]) -> None:
        """One of them is done, or has failed."""
        if row["status"] != "done":
            self.say(f"{row['status']}: {row['name']}: {row['message']}")
        self.advance(failed=row["status"] == "failed")

    def advance(self, *, failed: bool) -> None:
        """One more is done."""
        self.done += 1
        self.failed += failed
        if self._bar is not None:
            self._bar.update()
            if self.failed:
                self._bar.set_postfix_str(f"{self.failed:,} failed")
        elif time.monotonic() - self._told >= _LINE_EVERY_S:
            self._told = time.monotonic()
            self.say(self._line(self._told - self._began))

    def _line(self, spent_s: float) -> str:
        rate = self.done / spent_s
        left = _duration((self.to_do - self.done) / rate)
        failed = f", {self.failed:,} failed" if self.failed else ""
        unit = self._unit
        pace = f"{1 / rate:.1f} s a {unit}" if rate < 1 else f"{rate:.1f} {unit}s a second"
        return f"{self.done:,} of {self.to_do:,} {unit}s, {pace}, {left} left{failed}"


def _duration(seconds: float) -> str:
    minutes = round(seconds / 60)
    if minutes < 1:
        return f"{seconds:.0f} s"
    return f"{minutes} min" if minutes < 60 else f"{minutes // 60} h {minutes % 60} min"
