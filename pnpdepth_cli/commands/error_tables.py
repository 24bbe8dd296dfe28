"""The errors of a refined frame, or their means over a batch, as tables for terminal and report."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from pnpdepth_cli.choices import BASELINES
from pnpdepth_cli.commands.tables import Cell, Table
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
    for basis in bases or bases_of(errors):
        sides = [errors[basis].get(stage, {}) for stage in (BEFORE, AFTER, LINEAR)]
        count = "" if "frames" in sides[1] else f"{sides[1].get('points', 0):,} "
        start = f"error {BASES[basis].replace('at ', f'at {count}')}, "
        for key in (key for key in keys or _MEASURES if key in sides[0]):
            name = _title(key) if basis == GT else start + _title(key)
            values = [side.get(key) for side in sides]
            before, after, linear = (format_error(key, value, unit) for value in values)
            if basis == USED:  # which interpolation meets, and where a change proves nothing
                rows.append([name, before, after, "", "", ""])
            else:
                changes = [change(key, beside, values[1]) for beside in (values[0], values[2])]
                rows.append([name, before, after, changes[0], linear, changes[1]])
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
    keys, stages = ["mae"], errors.get(VALIDATION, {})
    scored = "too few points to validate the result at some"
    if GT in errors:
        keys, stages = ["rmse", "mae", "mre", "delta1"], errors[GT]
        scored = _describe_pixels(stages[AFTER])
    elif stages:
        scored = f"at {stages[LINEAR]['points']:,} validation points, which the rows did not get"
    shown = [stage for stage in _STAGES if stage in stages]
    # The result is no stage of its own where one expert, the network, has all the weight.
    of_one = sum(weight > 0 for weight in record.weights.values()) == 1 and ALONE not in shown
    shown = [stage for stage in shown if stage != AFTER or not of_one]
    last = next((stage for stage in reversed(shown) if stage != LINEAR), "")
    # A row for each stage, the last in bold.
    of_names = {"name": names[0], "fusing": names[-1], "weights": weights_text(record.weights)}
    rows = []
    for stage in shown:
        title, own = _STAGES[stage].format(**of_names), stages[stage]
        against = change("mae", stages[LINEAR]["mae"], own["mae"])
        row = _stage_row(title, [(key, own) for key in keys], record.unit, bold=stage == last)
        rows.append([*row, "" if stage == LINEAR else against])
    columns = ["", *map(_title, keys), "MAE vs linear"]
    return Table(title=f"{' + '.join(names)}; {scored}", columns=columns, rows=rows)


def _stage_row(
    title: str, scores: Sequence[tuple[str, Scores]], unit: str, *, bold: bool
) -> list[Cell]:
    """The title of a stage, and its errors: each the one of this key in the scores."""
    texts = [title, *(format_error(key, own.get(key), unit) for key, own in scores)]
    return [Cell(text, "bold" if bold else "") for text in texts]


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
    titles = {name: name for name in BASELINES} | {BEFORE: "network", AFTER: "result"}
    checked, scored = errors.get(VALIDATION, {}), errors.get(GT, {})
    columns = {"MAE, validation points": ("mae", checked)}
    if scored:
        columns |= {f"{key.upper()}, ground truth": (key, scored) for key in ("mae", "rmse")}
    maes = {stage: mae for stage, own in checked.items() if (mae := own.get("mae")) is not None}
    best_first = sorted((stage for stage in titles if stage in maes), key=maes.__getitem__)
    rows = []
    for stage in best_first or [each for each in titles if each in checked or each in scored]:
        own = [(key, stages.get(stage, {})) for key, stages in columns.values()]
        rows.append(_stage_row(titles[stage], own, unit, bold=stage == AFTER))
    return Table(title="against every simple baseline", columns=["", *columns], rows=rows)


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
    measure = _MEASURES[key]
    if before is None or after is None or math.isnan(before - after):
        return Cell("–", "dim")
    if before == 0 and not measure.percent:
        return Cell("–", "dim")
    rise = after - before if measure.percent else after / before - 1
    gain = measure.sign * rise
    text = f"{100 * rise:+.2f} pt" if measure.percent else f"{rise:+.1%}"
    return Cell(text, "good" if gain > 0 else "bad" if gain < 0 else "dim")


def _describe_pixels(scores: Scores) -> str:
    return (
        f"scored on {scores['pixels']:,} pixels of ground truth"
        f" ({scores['coverage']:.1%} of those known)"
    )
