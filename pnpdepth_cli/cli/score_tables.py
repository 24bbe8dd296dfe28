"""Evaluations and comparisons as tables on stdout; what was assumed and what is odd on stderr."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import click
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from pnpdepth_cli.cli.printable import printable
from pnpdepth_cli.errors import UsageError
from pnpdepth_cli.pipeline.evaluation.score_files import (
    bin_rows,
    check_targets,
    format_value,
    interval_text,
    unit_of,
    write_bytes,
)

if TYPE_CHECKING:
    from pnpdepth_cli.pipeline.evaluation.compare import Comparison
    from pnpdepth_cli.pipeline.evaluation.frame_scoring import FrameScores
    from pnpdepth_cli.pipeline.evaluation.result import ErrorBin, Evaluation
    from pnpdepth_cli.pipeline.evaluation.uncertainty import Uncertainty

_ALL_FRAMES_SHOWN = 12
_WORST_SHOWN = 5
_FRAME_COLUMNS = 6
_LABEL_LETTERS = 36


def print_notes(notes: Sequence[str]) -> None:
    """A line for each on stderr, warnings in a colour."""
    console = Console(stderr=True, highlight=False)
    for note in notes:
        style = "yellow" if note.startswith("warning") else "dim"
        console.print(escape(printable(note)), style=style, soft_wrap=True)


@dataclass(frozen=True, kw_only=True)
class TableFiles:
    """Where the tables of a command are written; `-` is stdout."""

    csv: Path | None
    """Target of the CSV text."""
    markdown: Path | None
    """Target of the Markdown text."""
    latex: Path | None
    """Target of the LaTeX text."""
    overwrite: bool
    """Whether existing files are replaced."""
    as_json: bool
    """Whether the result goes to stdout as JSON."""

    @property
    def targets(self) -> tuple[Path | None, Path | None, Path | None]:
        """CSV, Markdown and LaTeX."""
        return self.csv, self.markdown, self.latex

    def check(self, inputs: Sequence[Path]) -> None:
        """Checks the files before the work.

        Raises:
            UsageError: Two outputs go to one file or to stdout.
            OutputError: A file is an input, or exists and is not to be replaced.
        """
        if sum(str(path) == "-" for path in self.targets) + self.as_json > 1:
            raise UsageError(
                "only one of --json, --csv -, --markdown - and --latex - can go to stdout"
            )
        options: dict[Path, str] = {}
        for option, path in zip(("--csv", "--markdown", "--latex"), self.targets, strict=True):
            if path is not None and str(path) != "-":
                first = options.setdefault(path.resolve(), option)
                if first != option:
                    raise UsageError(
                        f"{first} and {option} are the same file {path}; name two files"
                    )
        check_targets(self.targets, inputs, overwrite=self.overwrite)

    def write(self, csv: str, markdown: str, latex: str) -> bool:
        """Writes the files that were named. Returns whether a text went to stdout."""
        for path, text in zip(self.targets, (csv, markdown, latex), strict=True):
            # a file name that is not UTF-8 has characters that cannot be encoded
            data = text.encode("utf-8", "backslashreplace")
            if str(path) == "-":
                click.echo(data, nl=False)
            elif path is not None:
                write_bytes(path, data)
        return any(str(path) == "-" for path in self.targets)


def print_evaluation(evaluation: Evaluation) -> None:
    """Prints the means, the frames or the worst of them, and errors by distance and by depth."""
    console = _stdout()
    _print(console, _means(evaluation))
    if evaluation.interval is not None:
        console.print(evaluation.describe_interval(), style="dim", soft_wrap=True)
    if len(evaluation.frames) > 1:
        _print(console, _frames(evaluation))
    if evaluation.uncertainty is not None:
        _print(console, _uncertainty(evaluation.uncertainty))
    for title, column, bins in (
        ("by distance to the nearest sparse point", "pixels away", evaluation.by_distance),
        ("by depth of the ground truth", "metres", evaluation.by_depth),
    ):
        if bins:
            _print(console, _bins(title, column, bins))


def print_comparison(comparison: Comparison) -> None:
    """Prints each measure of the first run, and of the others with their gain."""
    console = _stdout()
    base, *others = comparison.runs
    frames = len(comparison.names)
    table = _table(f"the {f'{frames:,} frames' if frames > 1 else 'frame'} that all runs have")
    for title in ("", "run", "mean", "gain", "95 % of the gain", "p"):
        table.add_column(title, justify="left" if title in ("", "run") else "right")
    for measure in comparison.measures:
        unit = f" [dim]{unit_of(measure)}[/]" if unit_of(measure) else ""
        first = format_value(measure, base.mean[measure.key])
        table.add_row(f"{measure.title}{unit}", _short(base.label), first, *["–"] * 3)
        for run, gains in zip(others, comparison.gains, strict=True):
            gain = gains[measure.key]
            table.add_row(
                "",
                _short(run.label),
                format_value(measure, run.mean[measure.key]),
                _coloured(gain.percent, significant=gain.p_adjusted < 0.05),
                _range(gain.low_percent, gain.high_percent),
                _p_value(gain.p_adjusted),
            )
        table.add_section()
    how = "all swaps" if comparison.exact else f"{comparison.resamples:,} random swaps"
    _print(console, table)
    caption = (
        f"gain: in per cent of {base.label}, positive is better; p: of no difference, from {how}"
        f" of {comparison.clusters.describe()}, adjusted for {len(comparison.measures)} measures"
        " (Holm)"
    )
    console.print(_one_line(caption), style="dim", soft_wrap=True)


def _short(label: str) -> str:
    """The run's label on one line, with its end if it is long."""
    text = printable(label)
    return escape(text if len(text) <= _LABEL_LETTERS else f"…{text[1 - _LABEL_LETTERS :]}")


def _means(evaluation: Evaluation) -> Table:
    measures, interval = evaluation.protocol.measures, evaluation.interval
    scored = len(evaluation.scored)
    one = scored == 1 and len(evaluation.frames) == 1
    table = _table(_one_line(evaluation.frames[0].name) if one else f"{scored:,} frames")
    table.show_header = not one
    table.add_column("")
    table.add_column("mean", justify="right")
    if interval is not None:
        table.add_column("95 %", justify="right")
    table.add_column("")
    for measure in measures:
        cells = [measure.title, format_value(measure, evaluation.mean[measure.key])]
        if interval is not None:
            cells.append(interval_text(evaluation, measure))
        better = "higher is better" if measure.higher_is_better else ""
        table.add_row(*cells, f"[dim]{unit_of(measure) or better}[/]")
    pixels = sum(frame.pixels for frame in evaluation.frames)
    table.add_section()
    cells = ["coverage", f"{evaluation.coverage:.2%}"] + [""] * (interval is not None)
    table.add_row(*cells, f"[dim]{pixels:,} pixels[/]")
    return table


def _frames(evaluation: Evaluation) -> Table:
    measures = evaluation.protocol.measures[:_FRAME_COLUMNS]
    by = next(measure for measure in measures if measure.key == "rmse")
    everything = len(evaluation.frames) <= _ALL_FRAMES_SHOWN
    frames = evaluation.frames if everything else evaluation.worst(by.key)[:_WORST_SHOWN]
    title = "frames" if everything else f"the {len(frames)} worst by {by.title}; --csv has all"
    table = _table(title)
    table.add_column("frame", overflow="fold")
    for measure in measures:
        unit = f" [dim]{unit_of(measure)}[/]" if unit_of(measure) else ""
        table.add_column(f"{measure.title}{unit}", justify="right")
    table.add_column("coverage", justify="right")
    for frame in frames:
        cells = [format_value(measure, frame.values.get(measure.key)) for measure in measures]
        table.add_row(_one_line(frame.name), *cells, _coverage(frame))
    return table


def _uncertainty(uncertainty: Uncertainty) -> Table:
    table = _table(f"standard deviation of {uncertainty.frames:,} frames")
    for column in ("", "observed", "calibrated"):
        table.add_column(column, justify="left" if not column else "right")
    table.add_row("errors within 1σ", f"{uncertainty.within_1_sigma:.1%}", "68.3%")
    table.add_row("errors within 2σ", f"{uncertainty.within_2_sigma:.1%}", "95.4%")
    table.add_row("AUSE (MAE, normalised)", f"{uncertainty.ause:.4f}", "0")
    return table


def _one_line(name: str) -> str:
    return escape(printable(name))


def _coverage(frame: FrameScores) -> str:
    if frame.missing:
        return "[red]missing[/]"
    return f"{frame.coverage:.2%}" if frame.scored else "[red]not scored[/]"


def _bins(title: str, column: str, bins: Sequence[ErrorBin]) -> Table:
    table = _table(f"{title}, all pixels together")
    table.add_column(column)
    for name in ("of the ground truth", "RMSE [dim]m[/]", "MAE [dim]m[/]", "MRE", "coverage"):
        table.add_column(name, justify="right")
    for cells in bin_rows(bins):
        table.add_row(*cells)
    return table


def _coloured(percent: float, *, significant: bool) -> str:
    if math.isnan(percent):
        return "–"
    colour = "dim" if not significant else "green" if percent > 0 else "red"
    return f"[{colour}]{percent:+.2f} %[/]"


def _range(low: float, high: float) -> str:
    return "–" if math.isnan(low) else f"{low:+.2f} … {high:+.2f}"


def _p_value(p_value: float) -> str:
    if math.isnan(p_value):
        return "–"
    return "< 0.001" if p_value < 0.001 else f"{p_value:.3f}"


def _table(title: str) -> Table:
    return Table(title=title, title_justify="left", box=SIMPLE_HEAD, pad_edge=False)


def _stdout() -> Console:
    return Console(highlight=False)


def _print(console: Console, table: Table) -> None:
    """Prints the table, as wide as needed unless stdout is a terminal."""
    if not console.is_terminal:
        wide = console.options.update(max_width=1000)
        console.width = max(console.width, console.measure(table, options=wide).maximum)
    console.print(table)
