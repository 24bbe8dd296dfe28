"""The errors of a refined frame, or their means over a batch, as tables for terminal and report."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from pnpdepth_cli.commands.tables import Cell, Style, Table
from pnpdepth_cli.measures import MEASURES

GT, HELD_OUT, VALIDATION, USED = "scores", "held_out_error", "validation", "sparse_error"
BASES = {
    GT: "against ground truth",
    HELD_OUT: "at held-out points",
    VALIDATION: "at validation points",
    USED: "at points used",
}
"""What errors are measured on, the best first. A change at the points used means nothing."""
_STAGES = {
    "aligned": "{name}, aligned with the points",
    "updated": "{name}, z updated",
    "propagated": "{name}, residual propagated",
    "alone": "{fusing} alone",
    "result": "fused ({weights})",
    "linear": "linear interpolation of all points",
}
"""Rows of the default method, by the name of the stage."""
_MEASURES = {measure.key: measure for measure in MEASURES}


def errors_by_basis(errors: Mapping[str, Any]) -> dict[str, dict[str, Mapping[str, Any]]]:
    """Returns the errors "before", "after" and of "linear" by their basis, the best first.

    Those at validation points are there only where no others say how good the result is.

    Args:
        errors: A record, a row of a summary, or a summary's means with its `linear`.
    """
    linear = errors["linear"] or {}
    found = {
        basis: {**errors[basis], "linear": linear.get(basis) or {}}
        for basis in (GT, HELD_OUT)
        if errors[basis]
    }
    if not found and (at := linear.get("validation")):
        stages = {"before": "aligned", "after": "result", "linear": "linear"}
        found[VALIDATION] = {side: at | {"mae": at[name]} for side, name in stages.items()}
    if errors[USED]:
        found[USED] = {**errors[USED], "linear": {}}
    return found


def error_table(
    title: str, errors: Mapping[str, Any], unit: str, keys: Sequence[str] | None = None
) -> Table:
    """Returns a row for each measure: before, after and change, and linear interpolation beside.

    Args:
        title: Of the table.
        errors: Argument of `errors_by_basis`.
        unit: Of the depths.
        keys: Of the measures, in this order; None for all.
    """
    rows = []
    for basis, sides in errors_by_basis(errors).items():
        before, after = sides["before"], sides["after"]
        count = f"{after['points']:,} " if "points" in after else ""
        for key in (key for key in keys or _MEASURES if key in before):
            name = _title(key)
            values = [side.get(key) for side in (before, after, sides["linear"])]
            shown = [format_error(key, value, unit) for value in values]
            changes = ["", ""]
            if basis != USED:
                changes = [change(key, beside, values[1]) for beside in (values[0], values[2])]
            if basis != GT:
                name = f"error {BASES[basis].replace('at ', f'at {count}')}, {name}"
            rows.append([name, *shown[:2], changes[0], shown[2], changes[1]])
    columns = ["", "before", "after", "change", "linear", "vs linear"]
    return Table(title=title, columns=columns, rows=rows)


def means_table(summary: Mapping[str, Any]) -> Table:
    """Returns the mean errors of a batch."""
    means = summary["mean"] | {"linear": summary["linear"]}
    counts = (f"{frames_of(e):,} {BASES[basis]}" for basis, e in errors_by_basis(means).items())
    title = f"means over frames: {', '.join(counts)}"
    return error_table(title, means, summary["unit"], summary.get("columns"))


def frames_of(errors: Mapping[str, Any]) -> int:
    """Returns the number of frames behind the means of a basis."""
    return int(errors["frames"] if "frames" in errors else errors["after"]["frames"])


def refinement_table(record: Mapping[str, Any]) -> Table:
    """Returns the errors of a record: by stage for the default method, else before and after."""
    scores = record["scores"]
    if record["method"]["kind"] == "default":
        return _stages_table(record)
    title = f"{record['model']['name']} cut at {record['settings']['layer']}"
    if scores is not None:
        title += f"; {_scored_on(scores['after'])}"
    return error_table(title, record, record["unit"])


def held_out_table(record: Mapping[str, Any]) -> Table:
    """Returns the errors of a record at its held-out points."""
    only = {**dict.fromkeys((GT, USED)), HELD_OUT: record[HELD_OUT], "linear": record["linear"]}
    return error_table("held-out points, which nothing used", only, record["unit"])


def made_by(record: Mapping[str, Any]) -> tuple[str, str]:
    """Returns what the depth before and the depth after of a record are of, in a few words."""
    settings = record["settings"]
    if record["method"]["kind"] == "default":
        name, weights = record["method"]["networks"][0], record["weights"]
        alone = all(weight == 0 for expert, weight in weights.items() if expert != name)
        after = _STAGES["propagated" if alone else "result"]
        before = _STAGES["aligned"].format(name=name)
        return before, after.format(name=name, weights=weights_text(weights))
    name, align = record["model"]["name"], settings["align"] != "none"
    before = f"{name}, aligned with the points" if align else name
    steps = [f"{settings['iterations']} updates of z"] if settings["iterations"] else []
    steps += ["residual propagated"] if settings["propagate"] != "none" else []
    return before, ", ".join([name, *steps])


def _stages_table(record: Mapping[str, Any]) -> Table:
    """The stages of the default method: scores on the ground truth, or at validation points."""
    beside, names = record["linear"], record["method"]["networks"]
    keys, rows, scored = ["mae"], dict[str, Any](), "too few points to validate the result at some"
    if record["stages"] is not None:
        rows = {stage["stage"]: stage["scores"] for stage in record["stages"]}
        rows |= {"result": record["scores"]["after"], "linear": beside["scores"]}
        keys, scored = ["rmse", "mae", "mre", "delta1"], _scored_on(rows["linear"])
    elif (at := beside["validation"]) is not None:
        rows = {name: {"mae": at[name]} for name in _STAGES if name in at}
        scored = f"at {at['points']:,} validation points, which the rows did not get"
    if sum(weight > 0 for weight in record["weights"].values()) == 1 and "alone" not in rows:
        rows.pop("result", None)  # the network's own
    last = [name for name in rows if name != "linear"][-1:]
    of_names = {"name": names[0], "fusing": names[-1], "weights": weights_text(record["weights"])}
    lines = []
    for name, scores in rows.items():
        style: Style = "bold" if [name] == last else ""
        against = "" if name == "linear" else change("mae", rows["linear"]["mae"], scores["mae"])
        cells = [format_error(key, scores[key], record["unit"]) for key in keys]
        title = _STAGES[name].format(**of_names)
        lines.append([*(Cell(text, style) for text in (title, *cells)), against])
    columns = ["", *(_title(key) for key in keys), "MAE vs linear"]
    return Table(title=f"{' + '.join(names)}; {scored}", columns=columns, rows=lines)


def weights_text(weights: Mapping[str, float]) -> str:
    """Returns the weights of experts as text, without those below half a per cent."""
    return ", ".join(f"{name} {w:.0%}" for name, w in weights.items() if w >= 0.005)


def mean_weights_text(weights: Mapping[str, Mapping[str, float]]) -> str:
    """Returns mean and range of each expert's weight in the frames of a batch, as text."""
    return ", ".join(
        f"{name} {each['mean']:.0%} ({each['least']:.0%} to {each['largest']:.0%})"
        for name, each in weights.items()
    )


def baselines_table(baselines: Mapping[str, Mapping[str, Any]], unit: str) -> Table:
    """Returns the baselines, the network and the result, best first at the validation points.

    Args:
        baselines: Of a record or a summary, by name.
        unit: Of the depths.
    """
    rows = {
        name: {"at_validation": row["validation_mae"], **(row.get("scores", row) or {})}
        for name, row in baselines.items()
    }
    titles = {"at_validation": "MAE, validation points"}
    if any(row.get("mae") is not None for row in rows.values()):
        titles |= {"mae": "MAE, ground truth", "rmse": "RMSE, ground truth"}
    known = {name: row for name, row in rows.items() if row["at_validation"] is not None}
    lines = []
    for name in sorted(known, key=lambda name: known[name]["at_validation"]) or list(rows):
        style: Style = "bold" if name == "result" else ""
        cells = [format_error("mae", rows[name].get(key), unit) for key in titles]
        lines.append([Cell(text, style) for text in (name, *cells)])
    columns = ["", *titles.values()]
    return Table(title="against every simple baseline", columns=columns, rows=lines)


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
