"""The errors of a refined frame, or their means over a batch, as tables for terminal and report."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from pnpdepth_cli.choices import BASELINES
from pnpdepth_cli.commands.tables import Cell, Style, Table
from pnpdepth_cli.dataset.frame_record import FrameRecord, Scores
from pnpdepth_cli.measures import MEASURES
from pnpdepth_cli.stages import (
    AFTER,
    ALONE,
    BASES,
    BEFORE,
    GT,
    HELD_OUT,
    LINEAR,
    PROPAGATED,
    UPDATED,
    USED,
    VALIDATION,
)

Errors = Mapping[str, Mapping[str, Scores]]
"""Scores by basis, then by stage, as `FrameRecord.errors` has them."""

_STAGES = {
    BEFORE: "{name}, aligned with the points",
    UPDATED: "{name}, z updated",
    PROPAGATED: "{name}, residual propagated",
    ALONE: "{fusing} alone",
    AFTER: "fused ({weights})",
    LINEAR: "linear interpolation of all points",
}
"""Rows of the default method, by stage."""
_MEASURES = {measure.key: measure for measure in MEASURES}


def bases_of(errors: Errors) -> list[str]:
    """Returns what errors are shown on, the best first.

    Validation points are there only where nothing else says how good the result is.
    """
    found = [basis for basis in BASES if errors.get(basis)]
    return [b for b in found if b != VALIDATION or not {GT, HELD_OUT} & set(found)]


def error_table(
    title: str,
    errors: Errors,
    unit: str,
    keys: Sequence[str] | None = None,
    bases: Sequence[str] | None = None,
) -> Table:
    """Returns a row for each measure: before, after and change, and linear interpolation beside.

    Args:
        title: Title of the table.
        errors: Errors of a frame, or their means.
        unit: Unit of the depths.
        keys: Keys of the measures, in this order; None for all.
        bases: Names of what the errors are on; None for `bases_of`.
    """
    rows = []
    for basis in bases_of(errors) if bases is None else bases:
        stages = errors[basis]
        sides = [stages.get(stage, {}) for stage in (BEFORE, AFTER, LINEAR)]
        count = "" if "frames" in sides[1] else f"{sides[1].get('points', 0):,} "
        for key in (key for key in keys or _MEASURES if key in sides[0]):
            name = _title(key)
            values = [side.get(key) for side in sides]
            if basis == USED:
                values[2] = None
            shown = [format_error(key, value, unit) for value in values]
            changes = ["", ""]
            if basis != USED:
                changes = [change(key, beside, values[1]) for beside in (values[0], values[2])]
            if basis != GT:
                name = f"error {BASES[basis].replace('at ', f'at {count}')}, {name}"
            rows.append([name, *shown[:2], changes[0], shown[2], changes[1]])
    columns = ["", "before", "after", "change", "linear", "vs linear"]
    return Table(title=title, columns=columns, rows=rows)


def means_table(errors: Errors, unit: str, keys: Sequence[str] | None = None) -> Table:
    """Returns the mean errors of a batch; its measures have these keys, or are all."""
    counts = (f"{errors[b][AFTER]['frames']:,} {BASES[b]}" for b in bases_of(errors))
    return error_table(f"means over frames: {', '.join(counts)}", errors, unit, keys)


def refinement_table(record: FrameRecord) -> Table:
    """Returns the errors of a record: by stage for the default method, else before and after."""
    assert record.method is not None
    if record.method.kind == "default":
        return _stages_table(record)
    assert record.model is not None
    title = f"{record.model.name} cut at {record.settings['layer']}"
    if GT in record.errors:
        title += f"; {_describe_pixels(record.errors[GT][AFTER])}"
    return error_table(title, record.errors, record.unit)


def held_out_table(record: FrameRecord) -> Table:
    """Returns the errors of a record at its held-out points."""
    title = "held-out points, which nothing used"
    return error_table(title, record.errors, record.unit, bases=[HELD_OUT])


def names_of_depths(record: FrameRecord) -> tuple[str, str]:
    """Returns what the depth before and the depth after of a record are of, in a few words."""
    assert record.method is not None
    assert record.model is not None
    settings = record.settings
    if record.method.kind == "default":
        name = record.method.networks[0]
        alone = all(weight == 0 for expert, weight in record.weights.items() if expert != name)
        after = _STAGES[PROPAGATED if alone else AFTER]
        before = _STAGES[BEFORE].format(name=name)
        return before, after.format(name=name, weights=weights_text(record.weights))
    name, align = record.model.name, settings["align"] != "none"
    before = f"{name}, aligned with the points" if align else name
    steps = [f"{settings['iterations']} updates of z"] if settings["iterations"] else []
    steps += ["residual propagated"] if settings["propagate"] != "none" else []
    return before, ", ".join([name, *steps])


def _stages_table(record: FrameRecord) -> Table:
    """The stages of the default method: scores on the ground truth, or at validation points."""
    assert record.method is not None
    names, errors = record.method.networks, record.errors
    keys, rows, scored = (
        ["mae"],
        dict[str, Scores](),
        "too few points to validate the result at some",
    )
    # Scores on the ground truth, or at validation points.
    if stages := errors.get(GT):
        rows = {name: stages[name] for name in _STAGES if name in stages}
        keys, scored = ["rmse", "mae", "mre", "delta1"], _describe_pixels(stages[LINEAR])
    elif stages := errors.get(VALIDATION):
        rows = {name: stages[name] for name in _STAGES if name in stages}
        scored = f"at {stages[LINEAR]['points']:,} validation points, which the rows did not get"
    # The result is no stage of its own where one expert has all the weight.
    if sum(weight > 0 for weight in record.weights.values()) == 1 and ALONE not in rows:
        rows.pop(AFTER, None)  # the network's own
    last = [name for name in rows if name != LINEAR][-1:]
    # A row for each stage, the last in bold.
    of_names = {"name": names[0], "fusing": names[-1], "weights": weights_text(record.weights)}
    lines = []
    for name, scores in rows.items():
        style: Style = "bold" if [name] == last else ""
        against = "" if name == LINEAR else change("mae", rows[LINEAR]["mae"], scores["mae"])
        cells = [format_error(key, scores[key], record.unit) for key in keys]
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


def has_baselines(errors: Errors) -> bool:
    """Returns whether every baseline was compared with, not only linear interpolation."""
    return any(name in stages for stages in errors.values() for name in BASELINES if name != LINEAR)


def baselines_table(errors: Errors, unit: str) -> Table:
    """Returns the baselines, the network and the result, best first at the validation points."""
    titles = {BEFORE: "network", AFTER: "result"}
    checked, scored = errors.get(VALIDATION, {}), errors.get(GT, {})
    names = [name for name in (*BASELINES, *titles) if name in checked or name in scored]
    columns = {"MAE, validation points": (checked, "mae")}
    if scored:
        columns |= {f"{key.upper()}, ground truth": (scored, key) for key in ("mae", "rmse")}
    known = [name for name in names if checked.get(name, {}).get("mae") is not None]
    lines = []
    for name in sorted(known, key=lambda name: checked[name]["mae"] or 0) or names:
        style: Style = "bold" if name == AFTER else ""
        cells = [
            format_error(key, stages.get(name, {}).get(key), unit)
            for stages, key in columns.values()
        ]
        lines.append([Cell(text, style) for text in (titles.get(name, name), *cells)])
    return Table(title="against every simple baseline", columns=["", *columns], rows=lines)


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


def _describe_pixels(scores: Scores) -> str:
    return (
        f"scored on {scores['pixels']:,} pixels of ground truth"
        f" ({scores['coverage']:.1%} of those known)"
    )
