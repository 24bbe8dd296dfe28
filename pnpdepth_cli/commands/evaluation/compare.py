"""`pnpdepth compare`: runs on the same frames side by side, and whether they really differ."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import PurePath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.commands.evaluation.dependence import MIN_CLUSTERS, Clusters, find_clusters
from pnpdepth_cli.commands.evaluation.pairing import some_names
from pnpdepth_cli.commands.evaluation.resampling import (
    LEVEL,
    FrameTable,
    gain,
    gain_interval,
    holm,
    swap_p_values,
)
from pnpdepth_cli.commands.evaluation.runs import Run, read_run
from pnpdepth_cli.commands.tables import chosen_measures
from pnpdepth_cli.core.metrics import Measure
from pnpdepth_cli.errors import InputError, UsageError
from pnpdepth_cli.io.record import plain

ALPHA = 0.05
MAIN_MEASURES = ("rmse", "mae", "mre", "delta1", "inverse_rmse", "inverse_mae")
"""Keys of the measures that are compared by default; the last two are the kit's."""


@dataclass(frozen=True, kw_only=True)
class Gain:
    """How much better a run is than the first one; positive is better for every measure.

    Values are NaN where there is none, as for a single frame.
    """

    percent: float
    """Of the first run's mean."""
    low_percent: float
    """Lower end of its 95 % interval, a studentised bootstrap over the clusters of frames."""
    high_percent: float
    difference: float
    """This run's mean minus the first run's, in the measure's unit."""
    p_value: float
    """Two-sided, of no difference, by swapping the runs cluster by cluster."""
    p_adjusted: float
    """The same, adjusted for the number of measures (Holm 1979)."""


@dataclass(frozen=True, kw_only=True)
class RunMean:
    """A run's means over the frames that all runs have."""

    label: str
    path: str
    mean: dict[str, float]
    coverage: float | None
    """Fraction of the ground truth's pixels that is scored; None where files do not say."""


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """Runs on the frames they share."""

    frames: tuple[str, ...]
    """Names of the shared ones."""
    measures: tuple[Measure, ...]
    """Those compared; p-values are adjusted for their number."""
    scoring: dict[str, Any]
    """The rules by which all runs were scored."""
    runs: tuple[RunMean, ...]
    """In the user's order; the first is what the others are compared with."""
    gains: tuple[dict[str, Gain], ...]
    """Of each run but the first, by the measure's key."""
    clusters: Clusters
    """What is resampled and swapped as a whole."""
    exact_p_values: bool
    """True if they are of all swaps, not of random ones."""
    resamples: int
    seed: int
    notes: tuple[str, ...]

    def as_record(self) -> dict[str, Any]:
        """Returns what `--json` prints; NaN is null."""
        clusters = {"count": self.clusters.count, "unit": self.clusters.unit}
        own = {"command": "compare", "level": LEVEL, "clusters": clusters}
        result: dict[str, Any] = plain(asdict(self) | own)
        return result


@dataclass(frozen=True, kw_only=True)
class CompareRequest:
    """Which runs to compare, and how their differences are tested."""

    paths: Sequence[str]
    """Files as `read_run` takes them; the first is the reference."""
    resamples: int = 10_000
    """Bootstrap samples, and the most swaps of the permutation test."""
    seed: int = 0
    grouped: bool = True
    """False if every frame counts as independent."""
    all_measures: bool = False
    """True to compare by every measure that all runs have, not only by MAIN_MEASURES."""
    columns: Sequence[str] | None = None
    """Keys of the measures to compare by, instead."""


def compare(request: CompareRequest) -> Comparison:
    """Returns the runs on the frames that all of them scored, compared with the first.

    A measure that a frame lacks in one of the runs is averaged and tested over the other frames.

    Raises:
        UsageError: For fewer than two runs.
        InputError: If they were scored by different rules, or have no frame in common.
    """
    if len(request.paths) < 2:
        raise UsageError("two runs at least are needed to compare")
    if request.resamples < 1:
        raise UsageError(f"--bootstrap must be >= 1, got {request.resamples}")
    runs = [read_run(path) for path in request.paths]
    for run in runs[1:]:
        _check_rules(runs[0], run)
    names = tuple(name for name in runs[0].frames if all(name in run.frames for run in runs))
    if not names:
        first, other = (some_names(run.frames) or "none" for run in (runs[0], runs[-1]))
        raise InputError(f"the runs have no scored frame in common: {first}; and {other}")
    measures = _measures(runs, request)
    keys = [measure.key for measure in measures]
    values = np.array(
        [[[run.frames[n].values.get(k, math.nan) for k in keys] for n in names] for run in runs]
    )
    known = np.isfinite(values).all(axis=0)
    differences = np.concatenate(list(values[1:] - values[0]), axis=1)
    groups = [runs[0].frames[name].group for name in names]
    clusters = find_clusters(groups, differences, grouped=request.grouped)
    if runs[0].pooled:
        sums = (np.array([run.frames[name].sums for name in names]) for run in runs)
        tables = [FrameTable.of_pixels(of_run, keys) for of_run in sums]
    else:
        tables = [FrameTable.of_frames(np.where(known, of_run, math.nan)) for of_run in values]
    gains, exact = [], True
    for table in tables[1:]:
        rows, exact = _gains(tables[0], table, measures, clusters, request)
        gains.append(dict(zip(keys, rows, strict=True)))
    return Comparison(
        frames=names,
        measures=measures,
        scoring=runs[0].scoring,
        runs=tuple(
            RunMean(
                label=label,
                path=run.path,
                mean=dict(zip(keys, table.mean().tolist(), strict=True)),
                coverage=_coverage(run, names),
            )
            for label, run, table in zip(_labels(runs), runs, tables, strict=True)
        ),
        gains=tuple(gains),
        clusters=clusters,
        exact_p_values=exact,
        resamples=request.resamples,
        seed=request.seed,
        notes=(
            *_notes(runs, names),
            *([] if runs[0].pooled else _lacking(names, measures, known)),
            *_cluster_notes(clusters, len(names), len(measures)),
        ),
    )


def _check_rules(first: Run, other: Run) -> None:
    rules = sorted({*first.scoring, *other.scoring})
    differing = [
        f"{rule} {first.scoring.get(rule)} and {other.scoring.get(rule)}"
        for rule in rules
        if first.scoring.get(rule) != other.scoring.get(rule)
    ]
    if differing:
        raise InputError(
            f"{first.path} and {other.path} were scored by different rules"
            f" ({'; '.join(differing)}); score both by one protocol"
        )


def _measures(runs: Sequence[Run], request: CompareRequest) -> tuple[Measure, ...]:
    """Those of all runs that the user chose, or the main ones."""
    shared = set.intersection(*({m.key for m in run.measures} for run in runs))
    common = [measure for measure in runs[0].measures if measure.key in shared]
    main = tuple(measure for measure in common if measure.key in MAIN_MEASURES)
    if request.columns is None and main and not request.all_measures:
        return main
    return chosen_measures(common, request.columns)


def _gains(
    first: FrameTable,
    other: FrameTable,
    measures: Sequence[Measure],
    clusters: Clusters,
    request: CompareRequest,
) -> tuple[list[Gain], bool]:
    """The gain of a run in each measure, and whether their p-values are exact."""
    better = np.array([1.0 if m.higher_is_better else -1.0 for m in measures])
    drawing = clusters.ids, request.resamples, request.seed
    low, high = gain_interval(first, other, better, *drawing)
    p_values, exact = swap_p_values(first, other, *drawing)
    before, after = first.mean(), other.mean()
    rows = (gain(before, after, better), low, high, after - before, p_values, holm(p_values))
    names = ("percent", "low_percent", "high_percent", "difference", "p_value", "p_adjusted")
    return [
        Gain(**dict(zip(names, row, strict=True))) for row in np.stack(rows, axis=1).tolist()
    ], exact


def _lacking(
    names: Sequence[str], measures: Sequence[Measure], known: NDArray[np.bool_]
) -> list[str]:
    """A line for each set of measures that some frames lack."""
    titles: dict[tuple[str, ...], list[str]] = {}
    for measure, has in zip(measures, known.T, strict=True):
        lacking = tuple(name for name, known_in in zip(names, has, strict=True) if not known_in)
        titles.setdefault(lacking, []).append(measure.title)
    return [
        f"{', '.join(of)}: over {len(names) - len(lacking):,} frames; {len(lacking):,} lack it in"
        f" a run: {some_names(lacking)}"
        for lacking, of in titles.items()
        if lacking
    ]


def _coverage(run: Run, names: Sequence[str]) -> float | None:
    frames = [run.frames[name] for name in names]
    known = [frame.known for frame in frames if frame.known is not None]
    if len(known) < len(frames) or not sum(known):
        return None
    return sum(frame.pixels for frame in frames) / sum(known)


def _labels(runs: Sequence[Run]) -> list[str]:
    """The shortest ends of the paths that tell the runs apart."""
    paths = [PurePath(run.path).with_name(run.label).parts for run in runs]
    for length in range(1, max(map(len, paths)) + 1):
        names = ["/".join(parts[-length:]) for parts in paths]
        if len(set(names)) == len(names):
            return names
    return [run.path for run in runs]


def _notes(runs: Sequence[Run], names: Sequence[str]) -> list[str]:
    """Warnings of frames and pixels that not all runs scored."""
    lines = []
    for run in runs:
        unshared = [name for name in run.frames if name not in set(names)]
        if unshared:
            lines.append(
                f"warning: {len(unshared):,} frames of {run.path} are not scored in all runs and"
                f" left out: {some_names(unshared)}"
            )
    frames = {name: [run.frames[name] for run in runs] for name in names}
    other_truth = [n for n, of in frames.items() if len({f.known for f in of} - {None}) > 1]
    if other_truth:
        lines.append(
            f"warning: {len(other_truth):,} frames have another number of pixels with ground truth"
            f" in another run, so the runs were not scored on the same: {some_names(other_truth)}"
        )
    elif any(len({frame.pixels for frame in of}) > 1 for of in frames.values()):
        shares = (
            (_coverage(run, names), sum(run.frames[name].pixels for name in names), run.path)
            for run in runs
        )
        listed = ", ".join(
            f"{f'{pixels:,} pixels' if share is None else f'{share:.2%}'} in {path}"
            for share, pixels, path in shares
        )
        lines.append(
            f"warning: coverage differs ({listed}), and a run that leaves hard pixels empty looks"
            " better; this is no ranking. Score with --missing max, or with one --mask"
        )
    return lines


def _cluster_notes(clusters: Clusters, frames: int, measures: int) -> list[str]:
    """A warning where the frames are too dependent, or too few, to conclude anything."""
    smallest = 2.0 ** (1 - clusters.count)
    if frames == 1 or measures * smallest < ALPHA:
        return []
    adjusted = min(1.0, measures * smallest)
    return [
        f"warning: {clusters.describe()} are too few independent ones to conclude anything from"
        f" {measures} measures: the smallest possible p is {smallest:.2g}, adjusted {adjusted:.2g}"
        + ("" if clusters.count >= MIN_CLUSTERS else f"; there is no interval below {MIN_CLUSTERS}")
    ]
