"""The errors of a refined frame, or their means over a batch, as tables for terminal and report."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from pnpdepth_cli.commands.tables import Cell, Style, Table
from pnpdepth_cli.measures import MEASURES

GT, HELD_OUT, HIDDEN, USED = "scores", "held_out_error", "check", "sparse_error"
BASES = {
    GT: "against ground truth",
    HELD_OUT: "at held-out points",
    HIDDEN: "at hidden points",
    USED: "at points used",
}
"""What errors are measured on, the best first. A change at the points used means nothing."""
_STAGES = {
    "aligned": "{name} aligned",
    "fused": "with points, fused",
    "updated": "z updated",
    "propagated": "residual propagated",
    "result": "result",
    "linear": "linear interpolation",
}
"""Rows of the default method, by the name of the stage."""
_MEASURES = {measure.key: measure for measure in MEASURES}


def errors_by_basis(errors: Mapping[str, Any]) -> dict[str, dict[str, Mapping[str, Any]]]:
    """Returns the errors "before", "after" and of "linear" by their basis, the best first.

    Those at hidden points are there only where no others say how good the result is.

    Args:
        errors: A record, a row of a summary, or a summary's means with its `linear`.
    """
    linear = errors["linear"] or {}
    found = {
        basis: {**errors[basis], "linear": linear.get(basis) or {}}
        for basis in (GT, HELD_OUT)
        if errors[basis]
    }
    if not found and (check := linear.get("check")):
        stages = {"before": "aligned", "after": "result", "linear": "linear"}
        found[HIDDEN] = {side: check | {"mae": check[name]} for side, name in stages.items()}
    if errors[USED]:
        found[USED] = {**errors[USED], "linear": {}}
    return found


def error_table(caption: str, errors: Mapping[str, Any], unit: str) -> Table:
    """Returns a row for each measure: before, after and change, and linear interpolation beside.

    Args:
        caption: Of the table.
        errors: As of `errors_by_basis`.
        unit: Of the depths.
    """
    rows = []
    for basis, sides in errors_by_basis(errors).items():
        before, after = sides["before"], sides["after"]
        count = f"{after['points']:,} " if "points" in after else ""
        for key in (key for key in _MEASURES if key in before):
            title = _title(key)
            values = [side.get(key) for side in (before, after, sides["linear"])]
            shown = [format_error(key, value, unit) for value in values]
            changes = ["", ""]
            if basis != USED:
                changes = [change(key, beside, values[1]) for beside in (values[0], values[2])]
            if basis != GT:
                title = f"error {BASES[basis].replace('at ', f'at {count}')}, {title}"
            rows.append([title, *shown[:2], changes[0], shown[2], changes[1]])
    header = ["", "before", "after", "change", "linear", "vs linear"]
    return Table(caption=caption, header=header, rows=rows)


def means_table(summary: Mapping[str, Any]) -> Table:
    """Returns the mean errors of a batch."""
    means = summary["mean"] | {"linear": summary["linear"]}
    counts = (f"{frames_of(e):,} {BASES[basis]}" for basis, e in errors_by_basis(means).items())
    return error_table(f"means over frames: {', '.join(counts)}", means, summary["unit"])


def frames_of(errors: Mapping[str, Any]) -> int:
    """Returns the number of frames behind the means of a basis."""
    return int(errors["frames"] if "frames" in errors else errors["after"]["frames"])


def refinement_table(record: Mapping[str, Any]) -> Table:
    """Returns the errors of a record: by stage for the default method, else before and after."""
    scores = record["scores"]
    if record["method"]["kind"] == "default":
        return _stages_table(record)
    caption = f"{record['model']['name']} cut at {record['settings']['layer']}"
    if scores is not None:
        caption += f"; {_scored_on(scores['after'])}"
    return error_table(caption, record, record["unit"])


def _stages_table(record: Mapping[str, Any]) -> Table:
    """The stages of the default method: scores on the ground truth, or errors at hidden points."""
    beside, names = record["linear"], record["method"]["networks"]
    keys, rows, caption = ["mae"], dict[str, Any](), "too few points to check the result at some"
    if record["stages"] is not None:
        rows = {stage["stage"]: stage["scores"] for stage in record["stages"]}
        rows |= {"result": record["scores"]["after"], "linear": beside["scores"]}
        keys, caption = ["rmse", "mae", "mre", "delta1"], _scored_on(rows["linear"])
    elif (check := beside["check"]) is not None:
        rows = {name: {"mae": check[name]} for name in _STAGES if name in check}
        caption = f"at {check['points']:,} points that were hidden from the method"
    if len(names) == 1:
        rows.pop("fused", None)
    if rows and rows["result"]["mae"] == rows["propagated"]["mae"]:
        del rows["result"]
    last = [name for name in rows if name != "linear"][-1:]
    lines = []
    for name, scores in rows.items():
        style: Style = "bold" if [name] == last else ""
        against = "" if name == "linear" else change("mae", rows["linear"]["mae"], scores["mae"])
        cells = [format_error(key, scores[key], record["unit"]) for key in keys]
        title = _STAGES[name].format(name=record["model"]["name"])
        lines.append([*(Cell(text, style) for text in (title, *cells)), against])
    header = ["", *(_title(key) for key in keys), "MAE vs linear"]
    return Table(caption=f"{' + '.join(names)}; {caption}", header=header, rows=lines)


def baselines_table(baselines: Mapping[str, Mapping[str, Any]], unit: str) -> Table:
    """Returns the baselines, the network and the result, best first at the held-out points.

    Args:
        baselines: Of a record or a summary, by name.
        unit: Of the depths.
    """
    rows = {
        name: {"held_out": row["held_out_mae"], **(row.get("scores", row) or {})}
        for name, row in baselines.items()
    }
    titles = {"held_out": "MAE, held-out points"}
    if any(row.get("mae") is not None for row in rows.values()):
        titles |= {"mae": "MAE, ground truth", "rmse": "RMSE, ground truth"}
    known = {name: row for name, row in rows.items() if row["held_out"] is not None}
    lines = []
    for name in sorted(known, key=lambda name: known[name]["held_out"]) or list(rows):
        style: Style = "bold" if name == "result" else ""
        cells = [format_error("mae", rows[name].get(key), unit) for key in titles]
        lines.append([Cell(text, style) for text in (name, *cells)])
    header = ["", *titles.values()]
    return Table(caption="against every simple baseline", header=header, rows=lines)


def format_error(key: str, value: float | None, unit: str) -> str:
    """Returns the value of a measure as text, lengths with their unit; – for NaN and None."""
    measure = _MEASURES[key]
    return measure.text(value, unit if measure.unit == "m" else "")


def _title(key: str) -> str:
    """The title of a measure, with its unit unless the values are lengths."""
    measure = _MEASURES[key]
    return measure.title if measure.unit in ("", "m") else f"{measure.title} [{measure.unit}]"


def change(key: str, before: float | None, after: float | None) -> Cell:
    """Returns how much a measure rose or fell, in per cent or percentage points."""
    if before is None or after is None or math.isnan(before) or math.isnan(after):
        return Cell("–", "dim")
    measure = _MEASURES[key]
    if measure.percent:
        rise, text = after - before, f"{100 * (after - before):+.2f} pt"
    elif before == 0:
        return Cell("–", "dim")
    else:
        rise, text = after / before - 1, f"{after / before - 1:+.1%}"
    gain = measure.sign * rise
    return Cell(text, "good" if gain > 0 else "bad" if gain < 0 else "dim")


def _scored_on(scores: Mapping[str, Any]) -> str:
    return (
        f"scored on {scores['pixels']:,} pixels of ground truth"
        f" ({scores['coverage']:.1%} of those known)"
    )
