"""Progress: bars on a terminal, a line per minute elsewhere."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING, Any

from pnpdepth_cli.cli.streams import printable, say

if TYPE_CHECKING:
    from tqdm import tqdm

    from pnpdepth_cli.dataset.frame_record import FrameRecord

_LINE_EVERY_S = 60.0
_SHOWN_AFTER_S = 1.0


@contextmanager
def progress_bar(title: str, unit: str, *, stays: bool = False) -> Iterator[Callable[..., None]]:
    """Yields `show(done, total, text="")`, which draws a bar for work of more than a second.

    Not on a terminal, it prints a line per minute. The time counts from the first call of `show`.
    A bar that stays is drawn from the beginning, and left at the end.
    """
    # The bar begins with the first call of `show`.
    bar: tqdm[Any] | None = None
    began = printed_at = 0.0

    def show(done: int, total: int, text: str = "") -> None:
        nonlocal bar, began, printed_at
        now = time.monotonic()
        if bar is None:
            from tqdm import tqdm

            tqdm.monitor_interval = 0  # without its thread, image libraries can be silenced
            bar = tqdm(
                desc=title, unit=unit, total=total, disable=None, dynamic_ncols=True,
                leave=stays, delay=0 if stays else _SHOWN_AFTER_S,
            )  # fmt: skip
            began = printed_at = now
        if bar.disable and done and now - printed_at >= _LINE_EVERY_S:
            printed_at = now
            say(_pace(done, total, unit, now - began) + (f", {text}" if text else ""))
        bar.set_postfix_str(text, refresh=False)
        bar.update(done - bar.n)

    try:
        yield show
    finally:
        if bar is not None:
            bar.close()


class BatchProgress:
    """Progress of a run over frames on stderr.

    `done`, `failed` and `to_do` are numbers of frames.
    """

    def __init__(self) -> None:
        self.done = self.to_do = self.failed = 0
        self._said: set[str] = set()
        self._open = ExitStack()
        self._show = self._open.enter_context(progress_bar("batch", "frame", stays=True))

    def __enter__(self) -> BatchProgress:
        return self

    def __exit__(self, *_: object) -> None:
        self._open.close()

    def say(self, text: str) -> None:
        """Prints a line on stderr, above the bar."""
        from tqdm import tqdm

        tqdm.write(printable(text), file=sys.stderr)

    def begin(self, to_do: int) -> None:
        """Starts counting; `to_do` frames follow."""
        self.to_do = to_do
        self._show(0, to_do)

    def frame(self, record: FrameRecord) -> None:
        """Counts a frame, and prints why it failed if it did; what was said of it is not again."""
        line = f"{record.status}: {record.name}: {record.message}"
        if record.status != "done" and line not in self._said:
            self._said.add(line)
            self.say(line)
        self.done += 1
        self.failed += record.status == "failed"
        self._show(self.done, self.to_do, f"{self.failed:,} failed" if self.failed else "")


def _pace(done: int, total: int, unit: str, spent_s: float) -> str:
    rate = done / spent_s
    pace = f"{1 / rate:.1f} s a {unit}" if rate < 1 else f"{rate:.1f} {unit}s a second"
    return f"{done:,} of {total:,} {unit}s, {pace}, {_duration((total - done) / rate)} left"


def _duration(seconds: float) -> str:
    minutes = round(seconds / 60)
    if minutes < 1:
        return f"{seconds:.0f} s"
    return f"{minutes} min" if minutes < 60 else f"{minutes // 60} h {minutes % 60} min"
