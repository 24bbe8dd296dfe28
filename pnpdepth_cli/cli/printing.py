"""Tables: results of commands on stdout and stderr, and the files they are written to."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table as RichTable
from rich.text import Text

from pnpdepth_cli.cli.terminal import printable, say
from pnpdepth_cli.commands.requests import check_outputs
from pnpdepth_cli.commands.shared import tables
from pnpdepth_cli.dataset.frame_record import FrameRecord
from pnpdepth_cli.errors import UsageError
from pnpdepth_cli.measures import GT

if TYPE_CHECKING:
    from pnpdepth_cli.commands.many_frames.summary import BatchSummary
    from pnpdepth_cli.commands.shared.sparse_files import Written

_STDOUT = Path("-")
_WIDE = 1000
"""Columns of what is no terminal."""
_NAMED = 3
"""Names of frames that are listed with a warning or note."""
_COLOURS = {"": "", "bold": "bold", "dim": "dim", "good": "green", "bad": "red"}
"""rich's style of each style of a cell."""


def check_tables(
    *named: Path | None, inputs: Sequence[Path], overwrite: bool, as_json: bool
) -> None:
    """Raises an error for files of tables that cannot be written.

    Args:
        named: Files that the user named for --csv and --latex; `-` is stdout, None was not named.
        inputs: Files that are read, which no table may replace.
        overwrite: Whether existing files may be replaced.
        as_json: Whether JSON goes to stdout.

    Raises:
        UsageError: Two of them go to stdout, or to one file.
        OutputError: A file exists and may not be replaced, is an input, or lies in no folder.
    """
    files = [path for path in named if path not in (None, _STDOUT)]
    if named.count(_STDOUT) + as_json > 1:
        raise UsageError("only one of --json, --csv - and --latex - can go to stdout")
    check_outputs(files, inputs, overwrite=overwrite)
    if len({os.path.realpath(path) for path in files}) < len(files):
        raise UsageError(f"--csv and --latex are the same file {files[0]}; name two files")


def write_tables(texts: Mapping[Path | None, str]) -> bool:
    """Writes the texts. Returns whether one went to stdout.

    Args:
        texts: Texts by the file to write; `-` is stdout, and the text of None is not written.
    """
    for path, text in texts.items():
        if path == _STDOUT:
            click.echo(text.encode("utf-8", "backslashreplace"), nl=False)
        elif path is not None:
            tables.write_text(path, text)
    return _STDOUT in texts


def print_table(table: tables.Table, *, err: bool = False) -> None:
    """Prints a table on stdout or stderr, as wide as needed unless that is a terminal."""
    console = Console(stderr=err, highlight=False)
    if not console.is_terminal:
        console.width = _WIDE
    title = Text(printable(table.title), style="table.title")
    shown = RichTable(title=title, title_justify="left", box=SIMPLE_HEAD, pad_edge=False)
    first, *others = map(Text, table.headings)
    shown.add_column(first, overflow="fold", no_wrap=True)
    for heading in others:
        shown.add_column(heading, overflow="fold", justify="right")
    for row in table.cells:
        shown.add_row(*(Text(printable(text), _COLOURS[style]) for text, style in row))
    console.print(shown)


def print_notes(notes: Sequence[str]) -> None:
    """Prints a line for each on stderr, warnings in a colour."""
    for note in notes:
        is_warning = note.startswith("warning")
        colour = "yellow" if is_warning else None
        click.secho(printable(note), err=True, fg=colour, dim=not is_warning)


def print_refinement(record: FrameRecord) -> None:
    """Prints the end of `pnpdepth refine`: notes, errors before and after, files, times."""
    result = record.refined()
    # Notes and tables of errors.
    print_notes(record.notes)
    for table in tables.refinement_tables(record):
        print_table(table, err=True)
    if record.worse_than_linear:
        print_notes(["warning: this depth is worse than linear interpolation of the points"])
    if result.improved_fraction is not None:
        compared = "scored pixels" if GT in record.errors else "held-out points"
        say(f"improved: {result.improved_fraction:.1%} of the {compared}")
    # Updates, times and memory, on one line.
    facts = []
    updates = len(result.loss) - 1  # the first loss is that before any update
    if updates > 0:
        settings = result.settings
        rule = f"{settings['update']}, {settings['loss']}, step {settings['step']:.3g}"
        facts.append(f"{tables.count_of(updates, 'update')} of z ({rule})")
    facts.append(_times(result.seconds))
    facts.append(f"peak {result.peak_memory_mb['process']:,.0f} MB")
    say(" · ".join(facts))
    # The files.
    say(f"wrote {'  '.join(result.outputs.values())}")
    if result.depth_scale is not None:
        say(
            f"{result.outputs['depth']} has {result.depth_scale:g} integers per metre, 0 is unknown"
        )


def _times(seconds: Mapping[str, float]) -> str:
    """The times as `read 0.04 s, load network 4.10 s (import 2.02, weights 0.61, layer 0.90)`.

    Args:
        seconds: Seconds by stage, and by `STAGE: PART` those of a part of a stage.
    """
    texts = []
    for stage, spent in seconds.items():
        if ": " in stage:  # a part, which stands in the brackets of its stage
            continue
        text = f"{stage} {spent:.2f} s"
        beginning = f"{stage}: "
        parts = [
            f"{name.removeprefix(beginning)} {spent_on:.2f}"
            for name, spent_on in seconds.items()
            if name.startswith(beginning)
        ]
        if parts:
            text += f" ({', '.join(parts)})"
        texts.append(text)
    return ", ".join(texts)


def print_batch(summary: BatchSummary, printed: set[str]) -> None:
    """Prints the end of `pnpdepth batch`: mean errors before and after, counts, files.

    Args:
        summary: The batch's summary.
        printed: Notes that were printed before, and are not printed again; gets those of this
            batch.
    """
    counts = summary.counts
    for table in tables.means_tables(summary.errors, summary.unit, summary.titles, summary.columns):
        print_table(table, err=True)
    print_notes([note for note in summary.notes if note not in printed])
    printed.update(summary.notes)
    # Counts of frames.
    texts = [f"{counts['done']:,} of {tables.count_of(counts['frames'], 'frame')} done"]
    for status in ("diverged", "failed", "pending", "with_warnings"):
        if counts[status]:
            texts.append(f"{counts[status]:,} {status.replace('_', ' ')}")
    if counts["compared"]:
        worse = f"{counts['worse']:,} of {counts['compared']:,}"
        texts.append(f"{worse} worse than linear interpolation")
    say(", ".join(texts))
    # A warning or note of several frames is one line, which names the first of them.
    for note, names in summary.frame_notes.items():
        first_names = ", ".join(tables.short_names(names[:_NAMED]))
        if len(names) > _NAMED:
            first_names += ", …"
        kind = "warning" if note.startswith("warning") else "note"
        count = tables.count_of(len(names), "frame")
        line = f"{kind} in {count} ({first_names}): {note.removeprefix(f'{kind}: ')}"
        if line not in printed:
            say(line)
        printed.add(line)
    # Weights and files.
    if summary.weights:
        say(f"mean weights in the result: {tables.mean_weights_text(summary.weights)}")
    say(f"wrote {summary.output}/summary.json  {summary.output}/summary.csv")


def print_sparse(written: Written) -> None:
    """Prints the end of `pnpdepth project`, `sample` and `simulate`: notes, points, files."""
    points, notes, files = written
    print_notes(notes)
    height, width = points.size
    share = f"{len(points) / (height * width):.2%} of {width}×{height} pixels"
    say(f"wrote {len(points):,} points, {share}: {'  '.join(map(str, files))}")
