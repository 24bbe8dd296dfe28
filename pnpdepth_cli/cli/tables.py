"""Tables: results of commands on stdout and stderr, and the files they are written to."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import click
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table as RichTable

from pnpdepth_cli.cli.printable import printable
from pnpdepth_cli.commands.tables import Cell, Table, write_text
from pnpdepth_cli.errors import OutputError, UsageError

_COLOURS = {"": "", "bold": "bold", "dim": "dim", "good": "green", "bad": "red"}


@dataclass(frozen=True, kw_only=True)
class TableFiles:
    """Where the tables of a command are written; `-` is stdout."""

    csv: Path | None
    markdown: Path | None
    latex: Path | None
    overwrite: bool
    """Whether existing files are replaced."""
    as_json: bool
    """Whether the result goes to stdout as JSON."""

    def check(self, inputs: Sequence[Path]) -> None:
        """Checks the files before the work.

        Raises:
            UsageError: Two outputs go to one file or to stdout.
            OutputError: A file is an input, or exists and is not to be replaced.
        """
        named = {"--csv": self.csv, "--markdown": self.markdown, "--latex": self.latex}
        if sum(str(path) == "-" for path in named.values()) + self.as_json > 1:
            raise UsageError(
                "only one of --json, --csv -, --markdown - and --latex - can go to stdout"
            )
        options: dict[Path, str] = {}
        for option, path in named.items():
            if path is None or str(path) == "-":
                continue
            first = options.setdefault(path.resolve(), option)
            if first != option:
                raise UsageError(f"{first} and {option} are the same file {path}; name two files")
            if path.resolve() in {source.resolve() for source in inputs}:
                raise OutputError(f"{path} is one of the inputs; name another output")
            if path.exists() and not self.overwrite:
                raise OutputError(f"{path} exists; --overwrite replaces it")
            if not path.parent.is_dir():
                raise OutputError(f"{path}: its folder does not exist; create it first")

    def write(self, *, csv: Table, markdown: Table, latex: Table) -> bool:
        """Writes the files that were named. Returns whether a text went to stdout."""
        targets = (
            (self.csv, csv.csv),
            (self.markdown, markdown.markdown),
            (self.latex, latex.latex),
        )
        for path, text in targets:
            if str(path) == "-":
                click.echo(text().encode("utf-8", "backslashreplace"), nl=False)
            elif path is not None:
                write_text(path, text())
        return any(str(path) == "-" for path, _ in targets)


def print_table(table: Table) -> None:
    """Prints a table on stdout, as wide as needed unless stdout is a terminal."""
    console = Console(highlight=False)
    shown = RichTable(
        title=escape(printable(table.caption)),
        title_justify="left",
        box=SIMPLE_HEAD,
        pad_edge=False,
    )
    for number, column in enumerate(table.header):
        first = number == 0
        shown.add_column(
            escape(column), overflow="fold", justify="left" if first else "right", no_wrap=first
        )
    for row in table.rows:
        shown.add_row(*map(_markup, row))
    if not console.is_terminal:
        wide = console.options.update(max_width=1000)
        console.width = max(console.width, console.measure(shown, options=wide).maximum)
    console.print(shown)


def print_rows(title: str, columns: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Prints a table on stdout; its arguments are those of `Table`."""
    print_table(Table(caption=title, header=columns, rows=rows))


def _markup(cell: str) -> str:
    text = escape(printable(cell))
    colour = _COLOURS[cell.style] if isinstance(cell, Cell) else ""
    return f"[{colour}]{text}[/]" if colour else text


def print_notes(notes: Sequence[str]) -> None:
    """Prints a line for each on stderr, warnings in a colour."""
    console = Console(stderr=True, highlight=False)
    for note in notes:
        style = "yellow" if note.startswith("warning") else "dim"
        console.print(escape(printable(note)), style=style, soft_wrap=True)


_Row = tuple[str, str, Callable[[float], str]]
"""Title, key and text of an error."""
_SCORES: tuple[_Row, ...] = (
    ("RMSE", "rmse", "{:.4f} m".format),
    ("MAE", "mae", "{:.4f} m".format),
    ("MRE", "mre", "{:.4f}".format),
    ("iRMSE", "irmse", "{:.2f} 1/km".format),
    ("SILog", "silog", "{:.2f}".format),
    ("δ1", "delta1", "{:.2%}".format),
    ("δ2", "delta2", "{:.2%}".format),
    ("δ3", "delta3", "{:.2%}".format),
)
_CHECKED = {"before": "aligned", "after": "result", "linear": "linear"}
"""Columns of a fixed method, by what the check at hidden points calls them."""
_COLUMNS = ("", "before", "after", "change", "linear", "vs linear")
_STAGES_OF_DEFAULT = {
    "aligned": "{name} aligned",
    "fused": "with points, fused",
    "updated": "z updated",
    "propagated": "residual propagated",
    "result": "result",
    "linear": "linear interpolation",
}
"""Rows of the default method, by the name of the stage."""
_STAGE_SCORES = ("RMSE", "MAE", "MRE", "δ1")
_STAGES = {
    "read": "reading and decoding, beside the network",
    "refine": "network",
    "write": "scoring, encoding and writing, beside the network",
    "wall": "wall",
}


def print_refinement(record: Mapping[str, Any]) -> None:
    """Prints the end of `pnpdepth refine`: notes, errors before and after, files, times."""
    console = Console(stderr=True, highlight=False)
    print_notes(record["notes"])
    settings = record["settings"]
    is_default = record["method"]["kind"] == "default"
    console.print(_stages(record) if is_default else _before_and_after(record))
    if record["linear"]["worse"]:
        console.print(
            "[yellow]warning: this depth is worse than linear interpolation of the points[/]"
        )
    if record["baselines"] is not None:
        console.print(_baselines(record["baselines"], record["unit"]))
    if record["improved_fraction"] is not None:
        where = "pixels with ground truth" if record["scores"] else "points"
        console.print(f"improved: {record['improved_fraction']:.1%} of the {where}")
    updates = (
        f"{settings['iterations']} updates ({settings['update']}, {settings['loss']}, step"
        f" {settings['step']:.3g}) · "
    )
    console.print(
        ("" if is_default else updates)
        + ", ".join(f"{stage} {spent:.2f} s" for stage, spent in record["seconds"].items())
        + f" · peak {record['peak_memory_mb']['process']:,.0f} MB",
        soft_wrap=True,
    )
    _print_written(console, "wrote", record)


def _print_written(console: Console, start: str, record: Mapping[str, Any]) -> None:
    written = [path for path in record["outputs"].values() if path]
    console.print(f"{start} {escape('  '.join(written))}", soft_wrap=True)


def _empty(title: str, columns: Sequence[str]) -> RichTable:
    table = RichTable(title=escape(title))
    for column in columns:
        table.add_column(column, justify="right" if column else "left")
    return table


def _stages(record: Mapping[str, Any]) -> RichTable:
    """The stages of the default method: scores on the ground truth, or errors at hidden points."""
    beside, names = record["linear"], record["method"]["networks"]
    if record["stages"] is not None:
        rows = {each["stage"]: each["scores"] for each in record["stages"]}
        rows |= {"result": record["scores"]["after"], "linear": beside["scores"]}
        columns = [(title, key, show) for title, key, show in _SCORES if title in _STAGE_SCORES]
        caption = _scored_on(rows["linear"])
    elif (check := beside["check"]) is not None:
        rows = {name: {"mae": check[name]} for name in _STAGES_OF_DEFAULT if name in check}
        columns = [("MAE", "mae", partial(_length, unit=record["unit"]))]
        caption = f"at {check['points']:,} points that were hidden from the method"
    else:
        rows, columns = {}, []
        caption = "too few points to hide some and check the result"
    table = _empty(
        " + ".join(names), ["", *(title for title, *_ in columns), *["MAE vs linear"] * bool(rows)]
    )
    table.caption = caption
    if len(names) == 1:
        rows.pop("fused", None)
    if rows and rows["result"]["mae"] == rows["propagated"]["mae"]:
        del rows["result"]
    last = [name for name in rows if name != "linear"][-1:]
    for name, scores in rows.items():
        title = _STAGES_OF_DEFAULT[name].format(name=record["model"]["name"])
        against = "" if name == "linear" else _change("mae", rows["linear"]["mae"], scores["mae"])
        cells = [show(scores[key]) for _, key, show in columns]
        table.add_row(escape(title), *cells, against, style="bold" if [name] == last else None)
    return table


def _before_and_after(record: Mapping[str, Any]) -> RichTable:
    """The errors of a fixed method before and after, beside linear interpolation."""
    points, beside, unit = record["points"], record["linear"], record["unit"]
    table = _empty(f"{record['model']['name']} cut at {record['settings']['layer']}", _COLUMNS)
    used = _of_points(f"error at {points['used']:,} points used", unit)
    _add_rows(table, used, record["sparse_error"])
    held_out = _of_points(f"error at {points['held_out']:,} held-out points", unit)
    _add_rows(table, held_out, record["held_out_error"], beside["held_out_error"])
    if record["scores"] is not None:
        table.add_section()
        _add_rows(table, _SCORES, record["scores"], beside["scores"])
        table.caption = _scored_on(record["scores"]["after"])
    elif (check := beside["check"]) is not None:
        title = f"error at {check['points']:,} hidden points"
        errors = {name: {"mae": check[of]} for name, of in _CHECKED.items()}
        _add_rows(table, _of_points(title, unit, "mae"), errors, errors["linear"])
    return table


def _scored_on(scores: Mapping[str, Any]) -> str:
    return (
        f"scored on {scores['pixels']:,} pixels of ground truth"
        f" ({scores['coverage']:.1%} of those known)"
    )


def _baselines(rows: Mapping[str, Any], unit: str) -> RichTable:
    """Returns the baselines, the network and the result, best first at the held-out points."""
    keys = ("mae", "rmse") if any(row["scores"] for row in rows.values()) else ()
    columns = ["", "MAE, held-out points", *(f"{key.upper()}, ground truth" for key in keys)]
    table = _empty("against every simple baseline", columns)
    known = {name: row for name, row in rows.items() if row["held_out_mae"] is not None}
    for name in sorted(known, key=lambda name: known[name]["held_out_mae"]) or list(rows):
        row = rows[name]
        values = [row["held_out_mae"], *((row["scores"] or {}).get(key) for key in keys)]
        cells = [_length(value, unit) for value in values]
        table.add_row(name, *cells, style="bold" if name == "result" else None)
    return table


def print_batch(summary: Mapping[str, Any]) -> None:
    """Prints the end of `pnpdepth batch`: mean errors before and after, counts, files."""
    console = Console(stderr=True, highlight=False)
    mean, counts, unit = summary["mean"], summary["counts"], summary["unit"]
    beside = summary["linear"]
    if any(mean.values()):
        table = _empty("means over frames", _COLUMNS)
        _add_rows(table, _of_points("error at points used", unit), mean["sparse_error"])
        held_out, linear = mean["held_out_error"], beside["held_out_error"]
        _add_rows(table, _of_points("error at held-out points", unit), held_out, linear)
        if mean["scores"] is not None:
            table.add_section()
            _add_rows(table, _SCORES, mean["scores"], beside["scores"])
            table.caption = f"scored on the ground truth of {mean['scores']['frames']:,} frames"
        elif held_out is None and (check := beside["check"]) is not None:
            title = f"error at hidden points, {check['frames']:,} frames"
            errors = {name: {"mae": check[name]} for name in _CHECKED}
            _add_rows(table, _of_points(title, unit, "mae"), errors, errors["linear"])
        console.print(table)
    if summary["baselines"]:
        rows = {
            name: {"held_out_mae": row["held_out_mae"], "scores": row}
            for name, row in summary["baselines"].items()
        }
        console.print(_baselines(rows, unit))
    parts = [f"{counts['done']:,} of {counts['frames']:,} frames done"]
    parts += [
        f"{counts[kind]:,} {kind}" for kind in ("diverged", "failed", "pending") if counts[kind]
    ]
    if counts["with_warnings"]:
        parts.append(f"{counts['with_warnings']:,} with warnings")
    if beside["frames"]:
        worse = f"{beside['worse']:,} of {beside['frames']:,}"
        parts.append(f"{worse} worse than linear interpolation")
    console.print(", ".join(parts))
    output = summary["output"]
    console.print("wrote " + escape(f"{output}/summary.json  {output}/summary.csv"), soft_wrap=True)


def print_profile(profile: Mapping[str, Any]) -> None:
    """Prints the time of each stage of a batch."""
    console = Console(stderr=True, highlight=False)
    seconds, frames = profile["seconds"], profile["frames"]
    if not frames:
        console.print("no frame was refined; there are no times")
        return
    table = _empty("where the time went", ("", "seconds", "ms a frame", "of the time"))
    for stage, spent in seconds.items():
        cells = (f"{spent:.2f}", f"{1000 * spent / frames:.1f}", f"{spent / seconds['wall']:.1%}")
        table.add_row(_STAGES[stage], *cells)
    table.caption = f"{frames:,} frames, {profile['frames_per_second']:.2f} a second"
    console.print(table)


def print_sparse(record: Mapping[str, Any]) -> None:
    """Prints the end of `pnpdepth project`, `sample` and `simulate`: notes, points, files."""
    print_notes(record["notes"])
    points, (width, height) = record["points"], record["size"]
    start = (
        f"wrote {points['count']:,} points, {points['fraction_of_pixels']:.2%} of {width}×{height}"
        " pixels:"
    )
    _print_written(Console(stderr=True, highlight=False), start, record)


def _of_points(title: str, unit: str, *keys: str) -> list[_Row]:
    show = partial(_length, unit=unit)
    return [(f"{title}, {key.upper()}", key, show) for key in keys or ("mae", "rmse")]


def _add_rows(
    table: RichTable,
    rows: Sequence[_Row],
    errors: Mapping[str, Any] | None,
    linear: Mapping[str, Any] | None = None,
) -> None:
    """Adds rows of before, after, change, linear interpolation, and the change against it."""
    for title, key, show in rows if errors is not None else ():
        sides = (errors or {})["before"], (errors or {})["after"], linear or {}
        before, after, beside = (side.get(key) for side in sides)
        shown = ["–" if v is None or math.isnan(v) else show(v) for v in (before, after, beside)]
        changes = _change(key, before, after), _change(key, beside, after)
        table.add_row(title, *shown[:2], changes[0], shown[2], changes[1])


def _length(value: float | None, unit: str) -> str:
    return "–" if value is None or math.isnan(value) else f"{value:.4f} {unit}"


def _change(key: str, before: float | None, after: float | None) -> str:
    if before is None or after is None or math.isnan(before) or math.isnan(after):
        return "[dim]–[/]"
    if key.startswith("delta"):
        change, text = after - before, f"{100 * (after - before):+.2f} pt"
    elif before == 0:
        return "[dim]–[/]"
    else:
        change, text = 1 - after / before, f"{after / before - 1:+.1%}"
    colour = "green" if change > 0 else "red" if change < 0 else "dim"
    return f"[{colour}]{text}[/]"
