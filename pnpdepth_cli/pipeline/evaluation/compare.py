"""`pnpdepth compare`: runs on the same frames side by side, and whether they really differ."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from pnpdepth_cli.core.metrics import Measure
from pnpdepth_cli.errors import InputError, UsageError
from pnpdepth_cli.io.record import plain
from pnpdepth_cli.pipeline.evaluation.averages import (
    LEVEL,
    Floats,
    FrameTable,
    bootstrap,
    sign_flip_p_values,
)
from pnpdepth_cli.pipeline.evaluation.pairing import some_names
from pnpdepth_cli.pipeline.evaluation.runs import Run, read_run


@dataclass(frozen=True, kw_only=True)
class Gain:
    """How much better than the first run; positive is better, whichever way the measure points.

    percent: of the first run's mean. low_percent, high_percent: its 95 % interval, bootstrap over
    the frames. difference: of the means, this run's minus the first's. p_value: of no difference,
    two-sided, by swapping the runs frame by frame. NaN where there is none, as for a single frame.
    """

    percent: float
    low_percent: float
    high_percent: float
    difference: float
    p_value: float


@dataclass(frozen=True, kw_only=True)
class RunMean:
    """A run's means over the frames that all runs have, by the measure's key."""

    label: str
    path: str
    mean: dict[str, float]


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """Runs on the frames they share. gains: of each run but the first, by the measure's key."""

    names: tuple[str, ...]
    measures: tuple[Measure, ...]
    scoring: dict[str, Any]
    runs: tuple[RunMean, ...]
    gains: tuple[dict[str, Gain], ...]
    exact: bool
    resamples: int
    seed: int
    notes: tuple[str, ...]

    def as_record(self) -> dict[str, Any]:
        """What `--json` prints; NaN is null."""
        record = {
            "command": "compare",
            "frames": list(self.names),
            "scoring": self.scoring,
            "measures": [asdict(measure) for measure in self.measures],
            "runs": [asdict(run) for run in self.runs],
            "gains": [{key: asdict(gain) for key, gain in gains.items()} for gains in self.gains],
            "level": LEVEL,
            "resamples": self.resamples,
            "seed": self.seed,
            "exact_p_values": self.exact,
            "notes": list(self.notes),
        }
        found: dict[str, Any] = plain(record)
        return found


def compare(paths: Sequence[str], *, resamples: int = 10_000, seed: int = 0) -> Comparison:
    """The runs in these files (see `read_run`), on the frames that all of them scored.

    UsageError for fewer than two; InputError where they were scored by different rules, or have
    no frame in common.
    """
    if len(paths) < 2:
        raise UsageError("two runs at least are needed to compare")
    if resamples < 1:
        raise UsageError(f"--bootstrap {resamples}: at least one resample is needed")
    runs = [read_run(path) for path in paths]
    for run in runs[1:]:
        _check_rules(runs[0], run)
    names = tuple(name for name in runs[0].frames if all(name in run.frames for run in runs))
    if not names:
        first, other = (some_names(run.frames) or "none" for run in (runs[0], runs[-1]))
        raise InputError(f"the runs have no scored frame in common: {first}; and {other}")
    shared = set.intersection(*({m.key for m in run.measures} for run in runs))
    measures = tuple(measure for measure in runs[0].measures if measure.key in shared)
    keys = [measure.key for measure in measures]
    tables = [_table(run, names, keys) for run in runs]
    means = [table.mean() for table in tables]
    gains, exact = [], True
    for table in tables[1:]:
        found, exact = _gains(tables[0], table, measures, resamples, seed)
        gains.append(found)
    return Comparison(
        names=names,
        measures=measures,
        scoring=runs[0].scoring,
        runs=tuple(
            RunMean(label=label, path=run.path, mean=dict(zip(keys, mean.tolist(), strict=True)))
            for label, run, mean in zip(_labels(runs), runs, means, strict=True)
        ),
        gains=tuple(gains),
        exact=exact,
        resamples=resamples,
        seed=seed,
        notes=tuple(_notes(runs, names)),
    )


def _check_rules(first: Run, other: Run) -> None:
    rules = sorted({*first.scoring, *other.scoring})
    unlike = [
        f"{rule} {first.scoring.get(rule)} and {other.scoring.get(rule)}"
        for rule in rules
        if first.scoring.get(rule) != other.scoring.get(rule)
    ]
    if unlike:
        raise InputError(
            f"{first.path} and {other.path} were scored by different rules"
            f" ({'; '.join(unlike)}); score both by one protocol"
        )


def _table(run: Run, names: Sequence[str], keys: Sequence[str]) -> FrameTable:
    frames = [run.frames[name] for name in names]
    if run.pooled:
        return FrameTable(rows=np.array([frame.sums for frame in frames]), pooled=True)
    rows = np.array([[frame.values.get(key, math.nan) for key in keys] for frame in frames])
    return FrameTable(rows=rows)


def _gains(
    first: FrameTable,
    other: FrameTable,
    measures: Sequence[Measure],
    resamples: int,
    seed: int,
) -> tuple[dict[str, Gain], bool]:
    frames = len(first.rows)
    better = np.array([1.0 if m.higher_is_better else -1.0 for m in measures])

    def percent(a: Floats, b: Floats) -> Floats:
        with np.errstate(divide="ignore", invalid="ignore"):
            change = np.where(a == b, 0.0, 100 * better * (b - a) / np.abs(a))
        return np.where(np.isfinite(change), change, math.nan)

    def resampled(weights: Floats) -> Floats:
        return percent(first.means(weights), other.means(weights))

    def swapped(flips: Floats) -> Floats:
        moved = flips @ (other.rows - first.rows)
        a = first.of_totals(first.rows.sum(axis=0) + moved)
        b = other.of_totals(other.rows.sum(axis=0) - moved)
        return b - a

    a, b = first.mean(), other.mean()
    nothing = np.full(len(measures), math.nan)
    low, high, p_values, exact = nothing, nothing, nothing, True
    if frames > 1:
        low, high = bootstrap(resampled, frames, resamples, seed)
        p_values, exact = sign_flip_p_values(swapped, frames, resamples, seed)
    rows = zip(percent(a, b), low, high, b - a, p_values, strict=True)
    fields = ("percent", "low_percent", "high_percent", "difference", "p_value")
    return {
        measure.key: Gain(**dict(zip(fields, map(float, row), strict=True)))
        for measure, row in zip(measures, rows, strict=True)
    }, exact


def _labels(runs: Sequence[Run]) -> list[str]:
    """Short names, or the whole paths where short ones come twice."""
    names = [run.label for run in runs]
    return names if len(set(names)) == len(names) else [run.path for run in runs]


def _notes(runs: Sequence[Run], names: Sequence[str]) -> list[str]:
    lines = []
    shared = set(names)
    for run in runs:
        alone = [name for name in run.frames if name not in shared]
        if alone:
            lines.append(
                f"warning: {len(alone):,} frames of {run.path} are not scored in all runs and left"
                f" out: {some_names(alone)}"
            )
    frames = {name: [run.frames[name] for run in runs] for name in names}
    other_truth = [n for n, of in frames.items() if len({f.known for f in of} - {None}) > 1]
    other_pixels = [n for n, of in frames.items() if len({frame.pixels for frame in of}) > 1]
    if other_truth:
        lines.append(
            f"warning: {len(other_truth):,} frames have another number of pixels with truth in"
            f" another run, so they were not scored on the same: {some_names(other_truth)}"
        )
    elif other_pixels:
        pixels = ", ".join(
            f"{sum(run.frames[name].pixels for name in names):,} in {run.path}" for run in runs
        )
        lines.append(
            f"warning: predictions do not cover the same pixels ({pixels}), and errors are over"
            " what each covers; score them with one --mask"
        )
    return lines
