"""`pnpdepth compare`: runs on the same frames side by side, and whether they really differ."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import PurePath
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pnpdepth_cli.core.metrics import MEASURES, Measure
from pnpdepth_cli.errors import InputError, UsageError
from pnpdepth_cli.io.record import plain
from pnpdepth_cli.pipeline.evaluation.dependence import (
    MIN_CLUSTERS,
    Clusters,
    find_clusters,
    independent_frames,
)
from pnpdepth_cli.pipeline.evaluation.pairing import some_names
from pnpdepth_cli.pipeline.evaluation.resampling import (
    LEVEL,
    Floats,
    FrameTable,
    clusters_among,
    holm,
    known_together,
    sign_flip_p_values,
    studentised_interval,
)
from pnpdepth_cli.pipeline.evaluation.runs import Run, read_run

ALPHA = 0.05
MAIN_MEASURES = ("rmse", "mae", "mre", "delta1", "inverse_rmse", "inverse_mae")
"""Keys of the measures that are compared unless all are asked for; the last two are the kit's."""
_LEAST_COVERAGE_DIFFERENCE = 0.001
"""Runs whose scored fractions of the ground truth differ by more are not ranked silently."""


@dataclass(frozen=True, kw_only=True)
class Gain:
    """How much better a run is than the first one; positive is better for every measure.

    Values are NaN where there is none, as for a single frame.
    """

    percent: float = math.nan
    """Of the first run's mean."""
    low_percent: float = math.nan
    """Lower end of its 95 % interval, a studentised bootstrap over the clusters of frames."""
    high_percent: float = math.nan
    difference: float = math.nan
    """This run's mean minus the first run's, in the measure's unit."""
    p_value: float = math.nan
    """Two-sided, of no difference, by swapping the runs cluster by cluster."""
    p_adjusted: float = math.nan
    """The same, adjusted for the number of measures (Holm 1979)."""


@dataclass(frozen=True, kw_only=True)
class RunMean:
    """A run's means over the frames that all runs have."""

    label: str
    path: str
    mean: dict[str, float]
    coverage: float | None = None
    """Fraction of the ground truth's pixels that is scored; None where files do not say."""


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """Runs on the frames they share."""

    names: tuple[str, ...]
    """The shared frames."""
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
    exact: bool
    """True if the p-values are of all swaps, not of random ones."""
    resamples: int
    seed: int
    notes: tuple[str, ...] = ()

    def as_record(self) -> dict[str, Any]:
        """Returns what `--json` prints; NaN is null."""
        record = {
            "command": "compare",
            "frames": list(self.names),
            "scoring": self.scoring,
            "measures": [asdict(measure) for measure in self.measures],
            "runs": [asdict(run) for run in self.runs],
            "gains": [{key: asdict(gain) for key, gain in gains.items()} for gains in self.gains],
            "level": LEVEL,
            "clusters": {"count": self.clusters.count, "unit": self.clusters.unit},
            "resamples": self.resamples,
            "seed": self.seed,
            "exact_p_values": self.exact,
            "notes": list(self.notes),
        }
        result: dict[str, Any] = plain(record)
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
        raise UsageError(f"--bootstrap {request.resamples}: at least one resample is needed")
    runs = [read_run(path) for path in request.paths]
    for run in runs[1:]:
        _check_rules(runs[0], run)
    names = tuple(name for name in runs[0].frames if all(name in run.frames for run in runs))
    if not names:
        first, other = (some_names(run.frames) or "none" for run in (runs[0], runs[-1]))
        raise InputError(f"the runs have no scored frame in common: {first}; and {other}")
    shared = set.intersection(*({m.key for m in run.measures} for run in runs))
    common = [measure for measure in runs[0].measures if measure.key in shared]
    main = [measure for measure in common if measure.key in MAIN_MEASURES]
    measures = tuple(common if request.all_measures or not main else main)
    values = np.array([_values(run, names, measures) for run in runs])
    known = np.isfinite(values).all(axis=0) | runs[0].pooled
    clusters = independent_frames(len(names))
    if request.grouped:
        differences = np.concatenate(list(values[1:] - values[0]), axis=1)
        clusters = find_clusters([runs[0].frames[name].group for name in names], differences)
    means = [dict.fromkeys((m.key for m in measures), math.nan) for _ in runs]
    gains = [dict.fromkeys((m.key for m in measures), Gain()) for _ in runs[1:]]
    exact = True
    for frames, columns in known_together(known):
        if not frames.any():
            continue
        tested = [measures[column] for column in columns]
        tables = [
            _table(run, names, frames, of_run[frames][:, columns], tested)
            for run, of_run in zip(runs, values, strict=True)
        ]
        ids = clusters_among(clusters.ids, frames)
        for mean, table in zip(means, tables, strict=True):
            mean |= zip((m.key for m in tested), table.mean().tolist(), strict=True)
        for gain, table in zip(gains, tables[1:], strict=True):
            of_table, all_swaps = _gains(tables[0], table, tested, ids, request)
            gain |= of_table
            exact &= all_swaps
    return Comparison(
        names=names,
        measures=measures,
        scoring=runs[0].scoring,
        runs=tuple(
            RunMean(label=label, path=run.path, mean=mean, coverage=_coverage(run, names))
            for label, run, mean in zip(_labels(runs), runs, means, strict=True)
        ),
        gains=tuple(_adjusted(gain) for gain in gains),
        clusters=clusters,
        exact=exact,
        resamples=request.resamples,
        seed=request.seed,
        notes=(
            *_notes(runs, names),
            *_lacking(names, measures, known),
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


def _values(run: Run, names: Sequence[str], measures: Sequence[Measure]) -> Floats:
    """(N, M) the measures of the frames; NaN where a frame lacks one."""
    frames = [run.frames[name] for name in names]
    return np.array([[frame.values.get(m.key, math.nan) for m in measures] for frame in frames])


def _table(
    run: Run,
    names: Sequence[str],
    frames: NDArray[np.bool_],
    values: Floats,
    measures: Sequence[Measure],
) -> FrameTable:
    if not run.pooled:
        return FrameTable(rows=values)
    keys = [measure.key for measure in measures]
    kept = tuple(n for n, measure in enumerate(MEASURES) if measure.key in keys)
    sums = np.array([run.frames[name].sums for name, of in zip(names, frames, strict=True) if of])
    return FrameTable(rows=sums, pooled=True, kept=kept)


def _gains(
    first: FrameTable,
    other: FrameTable,
    measures: Sequence[Measure],
    ids: NDArray[np.int64],
    request: CompareRequest,
) -> tuple[dict[str, Gain], bool]:
    """The gains of a run by measure, not adjusted; and whether their p-values are exact."""
    better = torch.tensor([1.0 if m.higher_is_better else -1.0 for m in measures]).double()
    first_totals, other_totals = (table.cluster_totals(ids) for table in (first, other))
    clusters, columns = first_totals.shape

    def percent(a: Tensor, b: Tensor) -> Tensor:
        change = torch.where(a == b, torch.zeros_like(a), 100 * better * (b - a) / a.abs())
        return torch.where(change.isfinite(), change, torch.full_like(change, math.nan))

    def percent_of(totals: Tensor) -> Tensor:
        return percent(first.means_of(totals[..., :columns]), other.means_of(totals[..., columns:]))

    def swapped_difference(flips: Floats) -> Floats:
        moved = torch.from_numpy(flips @ (other_totals - first_totals))
        a = first.means_of(torch.from_numpy(first_totals.sum(axis=0)) + moved)
        b = other.means_of(torch.from_numpy(other_totals.sum(axis=0)) - moved)
        return np.asarray((b - a).numpy())

    totals = np.concatenate([first_totals, other_totals], axis=1)
    none = np.full(len(measures), math.nan)
    low, high, p_values, exact = none, none, none, True
    if clusters >= MIN_CLUSTERS:
        low, high = studentised_interval(percent_of, totals, request.resamples, request.seed)
    if clusters > 1:
        p_values, exact = sign_flip_p_values(
            swapped_difference, clusters, request.resamples, request.seed
        )
    first_mean, other_mean = first.mean(), other.mean()
    gains = percent(torch.from_numpy(first_mean), torch.from_numpy(other_mean)).numpy()
    rows = zip(gains, low, high, other_mean - first_mean, p_values, strict=True)
    names = ("percent", "low_percent", "high_percent", "difference", "p_value")
    return {
        measure.key: Gain(**dict(zip(names, map(float, row), strict=True)))
        for measure, row in zip(measures, rows, strict=True)
    }, exact


def _adjusted(gains: dict[str, Gain]) -> dict[str, Gain]:
    """The gains with p-values adjusted for their number."""
    adjusted = holm(np.array([gain.p_value for gain in gains.values()]))
    return {
        key: replace(gain, p_adjusted=float(p_value))
        for (key, gain), p_value in zip(gains.items(), adjusted, strict=True)
    }


def _lacking(
    names: Sequence[str], measures: Sequence[Measure], known: NDArray[np.bool_]
) -> list[str]:
    """A line for each set of measures that some frames lack."""
    lines = []
    for frames, columns in known_together(known):
        lacking = [name for name, has in zip(names, frames, strict=True) if not has]
        if lacking:
            titles = ", ".join(measures[column].title for column in columns)
            lines.append(
                f"{titles}: over {len(names) - len(lacking):,} frames; {len(lacking):,} lack it in"
                f" a run: {some_names(lacking)}"
            )
    return lines


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
    shared = set(names)
    for run in runs:
        unshared = [name for name in run.frames if name not in shared]
        if unshared:
            lines.append(
                f"warning: {len(unshared):,} frames of {run.path} are not scored in all runs and"
                f" left out: {some_names(unshared)}"
            )
    frames = {name: [run.frames[name] for run in runs] for name in names}
    other_truth = [n for n, of in frames.items() if len({f.known for f in of} - {None}) > 1]
    other_pixels = [n for n, of in frames.items() if len({frame.pixels for frame in of}) > 1]
    if other_truth:
        lines.append(
            f"warning: {len(other_truth):,} frames have another number of pixels with ground truth"
            f" in another run, so the runs were not scored on the same: {some_names(other_truth)}"
        )
    elif other_pixels:
        lines.append(_coverage_warning(runs, names))
    return lines


def _coverage_warning(runs: Sequence[Run], names: Sequence[str]) -> str:
    coverages = [_coverage(run, names) for run in runs]
    known = [coverage for coverage in coverages if coverage is not None]
    if len(known) == len(runs) and max(known) - min(known) > _LEAST_COVERAGE_DIFFERENCE:
        listed = ", ".join(f"{c:.2%} in {run.path}" for c, run in zip(known, runs, strict=True))
        return (
            f"warning: coverage differs ({listed}), and a run that leaves hard pixels empty looks"
            " better; this is no ranking. Score with --missing max, or with one --mask"
        )
    pixels = ", ".join(
        f"{sum(run.frames[name].pixels for name in names):,} in {run.path}" for run in runs
    )
    return (
        f"warning: predictions do not cover the same pixels ({pixels}), and errors are over what"
        " each covers; score them with --missing max, or with one --mask"
    )


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
