"""Results as tables on stderr."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.console import Console, JustifyMethod
from rich.markup import escape
from rich.table import Table

from pnpdepth_cli.cli.printable import printable

_SCORES: tuple[tuple[str, str, Callable[[float], str]], ...] = (
    ("RMSE", "rmse", lambda v: f"{v:.4f} m"),
    ("MAE", "mae", lambda v: f"{v:.4f} m"),
    ("MRE", "mre", lambda v: f"{v:.4f}"),
    ("iRMSE", "irmse", lambda v: f"{v:.2f} 1/km"),
    ("SILog", "silog", lambda v: f"{v:.2f}"),
    ("δ1", "delta1", lambda v: f"{v:.2%}"),
    ("δ2", "delta2", lambda v: f"{v:.2%}"),
    ("δ3", "delta3", lambda v: f"{v:.2%}"),
)


_STAGES = {
    "read": "reading and decoding, beside the network",
    "refine": "network",
    "write": "scoring, encoding and writing, beside the network",
    "wall": "wall",
}


_COLUMNS = ("", "before", "after", "change", "linear", "vs linear")


def print_refinement(record: Mapping[str, Any]) -> None:
    """Prints the end of `pnpdepth refine`: notes, errors before and after, files, times."""
    console = Console(stderr=True, highlight=False)
    _print_notes(console, record["notes"])
    settings, beside = record["settings"], record["linear"]
    is_default = record["method"]["kind"] == "default"
    console.print(_stages(record) if is_default else _before_and_after(record))
    if beside["worse"]:
        console.print(
            "[yellow]warning: this depth is worse than linear interpolation of the points[/]"
        )
    if record["baselines"] is not None:
        console.print(_baselines(record["baselines"], record["unit"]))
    if record["improved_fraction"] is not None:
        where = "pixels with ground truth" if record["scores"] else "points"
        console.print(f"improved: {record['improved_fraction']:.1%} of the {where}")
    seconds = record["seconds"]
    updates = (
        f"{settings['iterations']} updates ({settings['update']}, {settings['loss']}, step"
        f" {settings['step']:.3g}) · "
    )
    console.print(
        ("" if is_default else updates)
        + ", ".join(f"{stage} {spent:.2f} s" for stage, spent in seconds.items())
        + f" · peak {record['peak_memory_mb']['process']:,.0f} MB",
        soft_wrap=True,
    )
    written = [path for path in record["outputs"].values() if path]
    console.print("wrote " + escape("  ".join(written)), soft_wrap=True)


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


def _stages(record: Mapping[str, Any]) -> Table:
    """The stages of the default method: scores on the ground truth, or errors at hidden points."""
    beside, unit = record["linear"], record["unit"]
    names = " + ".join(record["method"]["networks"])
    table = Table(title=escape(names))
    table.add_column("")
    if record["stages"] is not None:
        rows = {each["stage"]: each["scores"] for each in record["stages"]}
        rows |= {"result": record["scores"]["after"], "linear": beside["scores"]}
        known = rows["linear"]
        columns = [(title, key, show) for title, key, show in _SCORES if title in _STAGE_SCORES]
        table.caption = (
            f"scored on {known['pixels']:,} pixels of ground truth"
            f" ({known['coverage']:.1%} of those known)"
        )
    elif (check := beside["check"]) is not None:
        rows = {name: {"mae": check[name]} for name in _STAGES_OF_DEFAULT if name in check}
        columns = [("MAE", "mae", partial(_length, unit=unit))]
        table.caption = f"at {check['points']:,} points that were hidden from the method"
    else:
        table.caption = "too few points to hide some and check the result"
        return table
    if len(record["method"]["networks"]) == 1:
        rows.pop("fused", None)
    if rows["result"]["mae"] == rows["propagated"]["mae"]:
        del rows["result"]
    for title, *_ in columns:
        table.add_column(title, justify="right")
    table.add_column("MAE vs linear", justify="right")
    for name, scores in rows.items():
        title = _STAGES_OF_DEFAULT[name].format(name=record["model"]["name"])
        against = "" if name == "linear" else _change("mae", rows["linear"]["mae"], scores["mae"])
        last = name == [row for row in rows if row != "linear"][-1]
        cells = [show(scores[key]) for _, key, show in columns]
        table.add_row(escape(title), *cells, against, style="bold" if last else None)
    return table


def _before_and_after(record: Mapping[str, Any]) -> Table:
    """The errors of a fixed method before and after, beside linear interpolation."""
    points, beside, unit = record["points"], record["linear"], record["unit"]
    table = Table(title=escape(f"{record['model']['name']} cut at {record['settings']['layer']}"))
    for column in _COLUMNS:
        table.add_column(column, justify="left" if not column else "right")
    used = f"error at {points['used']:,} points used"
    _point_rows(table, used, record["sparse_error"], unit=unit)
    held_out = f"error at {points['held_out']:,} held-out points"
    _point_rows(table, held_out, record["held_out_error"], beside["held_out_error"], unit=unit)
    if record["scores"] is not None:
        after = record["scores"]["after"]
        _score_rows(table, record["scores"], beside["scores"])
        table.caption = (
            f"scored on {after['pixels']:,} pixels of ground truth"
            f" ({after['coverage']:.1%} of those known)"
        )
    elif (check := beside["check"]) is not None:
        errors = {"before": check["aligned"], "after": check["result"], "linear": check["linear"]}
        _check_row(table, f"error at {check['points']:,} hidden points, MAE", errors, unit)
    return table


def _baselines(rows: Mapping[str, Any], unit: str) -> Table:
    """Returns the baselines, the network and the result, best first at the held-out points."""
    with_gt = any(row["scores"] for row in rows.values())
    table = Table(title="against every simple baseline")
    of_gt = ["MAE, ground truth", "RMSE, ground truth"] if with_gt else []
    columns = ["", "MAE, held-out points", *of_gt]
    for column in columns:
        table.add_column(column, justify="left" if not column else "right")
    known = {name: row for name, row in rows.items() if row["held_out_mae"] is not None}
    order = sorted(known, key=lambda name: known[name]["held_out_mae"]) or list(rows)
    for name in order:
        row = rows[name]
        cells = [_length(row["held_out_mae"], unit)]
        if with_gt:
            scores = row["scores"] or {}
            cells += [_length(scores.get(key), unit) for key in ("mae", "rmse")]
        table.add_row(name, *cells, style="bold" if name == "result" else None)
    return table


def print_batch(summary: Mapping[str, Any]) -> None:
    """Prints the end of `pnpdepth batch`: mean errors before and after, counts, files."""
    console = Console(stderr=True, highlight=False)
    mean, counts, unit = summary["mean"], summary["counts"], summary["unit"]
    if any(mean.values()):
        table = Table(title="means over frames")
        for column in _COLUMNS:
            table.add_column(column, justify="left" if not column else "right")
        beside = summary["linear"]
        _point_rows(table, "error at points used", mean["sparse_error"], unit=unit)
        _point_rows(
            table,
            "error at held-out points",
            mean["held_out_error"],
            beside["held_out_error"],
            unit=unit,
        )
        if mean["scores"] is not None:
            _score_rows(table, mean["scores"], beside["scores"])
            table.caption = f"scored on the ground truth of {mean['scores']['frames']:,} frames"
        elif mean["held_out_error"] is None and (check := beside["check"]) is not None:
            title = f"error at hidden points, {check['frames']:,} frames, MAE"
            _check_row(table, title, check, unit)
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
    parts += [f"{counts['with_warnings']:,} with warnings"] if counts["with_warnings"] else []
    if (compared := summary["linear"])["frames"]:
        parts += [
            f"{compared['worse']:,} of {compared['frames']:,} worse than linear interpolation"
        ]
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
    table = Table(title="where the time went")
    for column in ("", "seconds", "ms a frame", "of the time"):
        table.add_column(column, justify="left" if not column else "right")
    for stage, spent in seconds.items():
        table.add_row(
            _STAGES[stage],
            f"{spent:.2f}",
            f"{1000 * spent / frames:.1f}",
            f"{spent / seconds['wall']:.1%}",
        )
    table.caption = f"{frames:,} frames, {profile['frames_per_second']:.2f} a second"
    console.print(table)


def print_sparse(record: Mapping[str, Any]) -> None:
    """Prints the end of `pnpdepth project`, `sample` and `simulate`: notes, points, files."""
    console = Console(stderr=True, highlight=False)
    _print_notes(console, record["notes"])
    points, (width, height) = record["points"], record["size"]
    written = [path for path in record["outputs"].values() if path]
    console.print(
        f"wrote {points['count']:,} points, {points['fraction_of_pixels']:.2%} of {width}×{height}"
        f" pixels: {escape('  '.join(written))}",
        soft_wrap=True,
    )


def print_rows(title: str, columns: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Prints a table on stdout, as wide as needed unless stdout is a terminal."""
    console = Console(highlight=False)
    table = Table(title=title, title_justify="left", box=SIMPLE_HEAD, pad_edge=False)
    for number, column in enumerate(columns):
        first = number == 0
        justify: JustifyMethod = "left" if first else "right"
        table.add_column(column, overflow="fold", justify=justify, no_wrap=first)
    for row in rows:
        table.add_row(*(escape(cell) for cell in row))
    if not console.is_terminal:
        wide = console.options.update(max_width=1000)
        console.width = max(console.width, console.measure(table, options=wide).maximum)
    console.print(table)


def _print_notes(console: Console, notes: Sequence[str]) -> None:
    for note in notes:
        style = "yellow" if note.startswith("warning") else "dim"
        console.print(escape(printable(note)), style=style, soft_wrap=True)


def _point_rows(
    table: Table,
    title: str,
    error: Mapping[str, Any] | None,
    linear: Mapping[str, Any] | None = None,
    *,
    unit: str,
) -> None:
    if error is not None:
        before, after = error["before"], error["after"]
        for name, key in (("MAE", "mae"), ("RMSE", "rmse")):
            values = before.get(key), after.get(key), (linear or {}).get(key)
            table.add_row(f"{title}, {name}", *_cells(key, partial(_length, unit=unit), values))


def _score_rows(table: Table, scores: Mapping[str, Any], linear: Mapping[str, Any] | None) -> None:
    before, after = scores["before"], scores["after"]
    table.add_section()
    for title, key, show in _SCORES:
        values = before.get(key), after.get(key), (linear or {}).get(key)
        table.add_row(title, *_cells(key, show, values))


def _check_row(table: Table, title: str, errors: Mapping[str, float], unit: str) -> None:
    values = errors["before"], errors["after"], errors["linear"]
    table.add_row(title, *_cells("mae", partial(_length, unit=unit), values))


def _cells(
    key: str,
    show: Callable[[float], str],
    values: tuple[float | None, float | None, float | None],
) -> list[str]:
    """Before, after, change, linear interpolation, and the change against it."""
    before, after, linear = values
    shown = ["–" if v is None or math.isnan(v) else show(v) for v in values]
    return [*shown[:2], _change(key, before, after), shown[2], _change(key, linear, after)]


def _length(value: float | None, unit: str) -> str:
    return "–" if value is None or math.isnan(value) else f"{value:.4f} {unit}"


def _change(key: str, before: float | None, after: float | None) -> str:
    if before is None or after is None or math.isnan(before) or math.isnan(after):
        return "[dim]–[/]"
    if key.startswith("delta"):
        points = 100 * (after - before)
        colour = "green" if points > 0 else "red" if points < 0 else "dim"
        return f"[{colour}]{points:+.2f} pt[/]"
    if before == 0:
        return "[dim]–[/]"
    change = after / before - 1
    colour = "green" if change < 0 else "red" if change > 0 else "dim"
    return f"[{colour}]{change:+.1%}[/]"
