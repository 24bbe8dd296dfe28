"""The errors of a refined frame, or their means over a batch: a table with a row for each stage."""

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
)

Errors = Mapping[str, Mapping[str, Scores]]
"""Scores by basis, then by stage, as `FrameRecord.errors` has them."""

_LINEAR = "linear interpolation of all points"
_OF_DEFAULT = {
    BEFORE: "{name}, aligned with the points",
    UPDATED: "{name}, z updated",
    PROPAGATED: "{name}, residual propagated",
    ALONE: "{fusing} alone",
    AFTER: "fused ({weights})",
    LINEAR: _LINEAR,
}
"""Rows of a frame of the default method, by stage."""
_OF_BATCH = {
    BEFORE: "before",
    UPDATED: "z updated",
    PROPAGATED: "residual propagated",
    ALONE: "included network alone",
    AFTER: "after",
    LINEAR: _LINEAR,
    **{name: name for name in BASELINES if name != LINEAR},
}
"""Rows of a batch."""
_MEASURES = {measure.key: measure for measure in MEASURES}


def bases_of(errors: Errors) -> list[str]:
    """Returns what errors are shown on: ground truth and held-out points, else the best."""
    found = [basis for basis in BASES if errors.get(basis)]
    return [basis for basis in found if basis in (GT, HELD_OUT)] or found[:1]


def means_tables(errors: Errors, unit: str, keys: Sequence[str] | None = None) -> list[Table]:
    """Returns the mean errors of a batch on each basis; its measures have these keys."""
    bases = bases_of(errors)
    return [_table("means", basis, errors[basis], unit, _OF_BATCH, keys) for basis in bases]


def refinement_tables(record: FrameRecord) -> list[Table]:
    """Returns the errors of a record on each basis."""
    assert record.method is not None
    assert record.model is not None
    title = f"{record.model.name} cut at {record.settings.get('layer')}"
    if record.method.kind == "default":
        title = " + ".join(record.method.networks)
    tables = []
    for basis in bases_of(record.errors):
        stages, titles = record.errors[basis], _titles(record)
        # The result is no stage of its own where one expert, the network, has all the weight.
        of_one = sum(weight > 0 for weight in record.weights.values()) == 1
        if of_one and PROPAGATED in stages and ALONE not in stages:
            stages = {stage: own for stage, own in stages.items() if stage != AFTER}
        tables.append(_table(title, basis, stages, record.unit, titles))
    return tables


def _table(
    about: str,
    basis: str,
    stages: Mapping[str, Scores],
    unit: str,
    titles: Mapping[str, str],
    keys: Sequence[str] | None = None,
) -> Table:
    """A row for each stage in the order of the titles: its errors, also against linear ones."""
    shown = [stage for stage in titles if stage in stages]
    last = AFTER if AFTER in stages else PROPAGATED
    scores = stages[last]
    main = [measure.key for measure in MEASURES if measure.main]
    measures = [_MEASURES[key] for key in keys or main if key in scores]
    # How many pixels, points or frames they are of.
    count = f"{scores.get('points'):,} points" if "points" in scores else ""
    if "frames" in scores:
        count = f"{scores['frames']:,} frames"
    elif "coverage" in scores:
        count = f"{scores['pixels']:,} pixels ({scores['coverage']:.1%} of those known)"
    remark = ", where a change proves nothing" * (basis == USED)
    # The rows.
    rows, linear = [], stages.get(LINEAR, {}).get("mae")
    units = [unit if measure.unit == "m" else measure.unit for measure in measures]
    for stage in shown:
        own = stages[stage]
        style: Style = "bold" if stage == last else ""
        texts = (m.text(own.get(m.key), u) for m, u in zip(measures, units, strict=True))
        against = Cell("") if stage == LINEAR else change(linear, own.get("mae"))
        rows.append([*(Cell(text, style) for text in (titles[stage], *texts)), against])
    return Table(
        title=f"{about}: errors {BASES[basis]}{remark}, {count}",
        columns=["", *(measure.title for measure in measures), "MAE vs linear"],
        rows=rows,
    )


def _titles(record: FrameRecord) -> dict[str, str]:
    """The rows of a frame, by stage."""
    assert record.method is not None
    if record.method.kind == "default":
        names = record.method.networks
        of = {"name": names[0], "fusing": names[-1], "weights": weights_text(record.weights)}
        return {stage: title.format(**of) for stage, title in _OF_DEFAULT.items()}
    before, after = names_of_depths(record)
    return {BEFORE: before, AFTER: after, LINEAR: _LINEAR}


def names_of_depths(record: FrameRecord) -> tuple[str, str]:
    """Returns what the depth before and the depth after of a record are of, in a few words."""
    assert record.method is not None
    assert record.model is not None
    if record.method.kind == "default":
        titles, name = _titles(record), record.method.networks[0]
        alone = all(weight == 0 for expert, weight in record.weights.items() if expert != name)
        return titles[BEFORE], titles[PROPAGATED if alone else AFTER]
    name, settings = record.model.name, record.settings
    before = f"{name}, aligned with the points" if settings["align"] != "none" else name
    steps = [f"{settings['iterations']} updates of z"] if settings["iterations"] else []
    steps += ["residual propagated"] if settings["propagate"] != "none" else []
    return before, ", ".join([name, *steps])


def weights_text(weights: Mapping[str, float]) -> str:
    """Returns the weights of experts as text, without those below half a per cent."""
    return ", ".join(f"{name} {w:.0%}" for name, w in weights.items() if w >= 0.005)


def mean_weights_text(weights: Mapping[str, Mapping[str, float]]) -> str:
    """Returns mean and range of each expert's weight in the frames of a batch, as text."""
    return ", ".join(
        f"{name} {each['mean']:.0%} ({each['least']:.0%} to {each['largest']:.0%})"
        for name, each in weights.items()
    )


def change(before: float | None, after: float | None) -> Cell:
    """Returns how much an error rose or fell in per cent, as a good or a bad cell."""
    if not before or after is None or math.isnan(before - after):
        return Cell("–", "dim")
    rise = after / before - 1
    return Cell(f"{rise:+.1%}", "good" if rise < 0 else "bad" if rise > 0 else "dim")
