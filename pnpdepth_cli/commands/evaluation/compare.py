"""`pnpdepth compare`: runs on the same frames side by side, and whether they really differ."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, fields
from itertools import zip_longest
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.commands.evaluation.eval_request import WITHOUT_SPARSE, scoring_of
from pnpdepth_cli.commands.evaluation.pairing import some_names
from pnpdepth_cli.commands.statistics import (
    MIN_CLUSTERS,
    Clusters,
    find_clusters,
    gain,
    holm,
    interval,
    swap_p_values,
)
from pnpdepth_cli.commands.tables import Cell, Style, Table, count_of
from pnpdepth_cli.dataset.frame_files import groups_by_name
from pnpdepth_cli.dataset.frame_record import FrameRecord, Scores
from pnpdepth_cli.errors import FileFormatError, InputError, UsageError
from pnpdepth_cli.io.file_bytes import one_line
from pnpdepth_cli.io.text_files import plain, read_json
from pnpdepth_cli.measures import MEASURES, FrameMeans, Measure, choose_measures
from pnpdepth_cli.protocols import find_protocol
from pnpdepth_cli.stages import AFTER, BEFORE, GT

ALPHA = 0.05
PERMUTATIONS, SEED = 10_000, 0
"""Most swaps of the permutation test, and their seed where not all are tried."""
_SUMMARY = "summary.json"
_STARS = (0.05, 0.01, 0.001)


class Run(NamedTuple):
    """The scored frames of one saved run, by name."""

    name: str
    """Name of the folder, or of the file without its ending."""
    path: str
    measures: list[Measure]
    """Measures that all frames have."""
    scoring: dict[str, Any]
    scores: dict[str, Scores]
    """Scores of the depth that is compared: before or after refinement."""
    before: dict[str, Scores]
    """Scores before refinement; empty where there are none."""
    groups: dict[str, str | None]
    varied: dict[str, str]
    """Options that `batch --vary` varied, with their values; empty for other runs."""

    def counts(self, name: str) -> tuple[int, int]:
        """Returns the numbers of scored pixels and of pixels with ground truth of a frame."""
        scores = self.scores[name]
        pixels, coverage = scores.get("pixels") or 0, scores.get("coverage")
        known = scores.get("known", pixels / coverage if coverage else 0)
        return round(pixels), round(known or 0)

    def coverage(self, names: Sequence[str]) -> float:
        """Returns the fraction of the ground truth of these frames that is scored."""
        pixels, known = (sum(counts) for counts in zip(*map(self.counts, names), strict=True))
        return pixels / known if known else math.nan


@dataclass(frozen=True)
class Gain:
    """How much better a run is than the first by one measure; positive per cents are better."""

    percent: float | None
    """Gain in per cent of the first run's mean. None, as below, for a value that there is not."""
    low_percent: float | None
    """Lower end of the 95 % interval of `percent`."""
    high_percent: float | None
    difference: float | None
    """Mean of the run minus mean of the first."""
    p_value: float | None
    """Probability of such a difference between equal runs."""
    p_adjusted: float | None
    """The same by the number of tests, of all measures and runs."""


@dataclass(frozen=True, kw_only=True)
class ComparedRun:
    """A run on the frames that all runs scored."""

    name: str
    path: str
    mean: dict[str, float | None]
    before: dict[str, float | None]
    """The mean before refinement, where the run has it."""
    varied: dict[str, str]
    coverage: float
    gains: dict[str, Gain]
    """Gains by measure; empty for the first run."""


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """Runs on the frames that all of them scored, compared with the first."""

    frames: tuple[str, ...]
    measures: tuple[Measure, ...]
    scoring: dict[str, Any]
    runs: tuple[ComparedRun, ...]
    clusters: Clusters
    exact_p_values: bool
    """Whether all swaps were tried, not `PERMUTATIONS` random ones."""
    tests: int
    notes: list[str]

    def to_json(self) -> dict[str, Any]:
        """Returns what `--json` prints."""
        clusters = {"count": self.clusters.count, "unit": self.clusters.unit}
        measures = [measure.to_json() for measure in self.measures]
        values = {each.name: getattr(self, each.name) for each in fields(self)}
        own = {"clusters": clusters, "measures": measures, "permutations": PERMUTATIONS}
        result: dict[str, Any] = plain({"command": "compare"} | values | own)
        return result


def compare(paths: Sequence[str], *, columns: Sequence[str] | None = None) -> Comparison:
    """Returns the runs on the frames that all of them scored, compared with the first.

    A measure that a frame lacks in one of the runs is averaged and tested over the other frames.

    Args:
        paths: Files as `read_run` takes them; the first is the reference.
        columns: Keys of the measures to compare by, instead of the main ones.

    Raises:
        UsageError: For fewer than two runs.
        InputError: If they were scored by different rules, or have no frame in common.
    """
    if len(paths) < 2:
        raise UsageError("two runs at least are needed to compare")
    runs = [read_run(path) for path in paths]
    first = runs[0]
    for run in runs[1:]:
        _check_rules(first, run)
    # the frames and the measures that all runs have
    names = tuple(name for name in first.scores if all(name in run.scores for run in runs))
    if not names:
        own, other = (some_names(run.scores) or "none" for run in (first, runs[-1]))
        raise InputError(f"the runs have no scored frame in common: {own}; and {other}")
    measures = _shared_measures(runs, columns)
    keys = [measure.key for measure in measures]
    scores = [[[*map(run.scores[name].get, keys)] for name in names] for run in runs]
    values = np.array(scores, np.float64)  # (runs, frames, measures)
    known = np.asarray(np.isfinite(values).all(axis=0))
    values[:, ~known] = math.nan
    # the tests, over frames that count as independent
    by_name = zip(names, groups_by_name(names), strict=True)
    groups = [first.groups[name] or group for name, group in by_name]
    clusters = find_clusters(groups, np.concatenate(list(values[1:] - values[0]), axis=1))
    means = [_means(keys, of_run) for of_run in values.tolist()]
    gains, exact = _gains(values, means, measures, clusters)
    tests = len(gains) * len(measures)
    return Comparison(
        frames=names,
        measures=measures,
        scoring=first.scoring,
        runs=tuple(
            ComparedRun(
                name=name,
                path=run.path,
                mean=mean,
                before=_means(keys, ([*map(run.before[frame].get, keys)] for frame in names)),
                varied=run.varied,
                coverage=run.coverage(names),
                gains=of_first,
            )
            for run, name, mean, of_first in zip(
                runs, _names(runs), means, [{}, *gains], strict=True
            )
        ),
        clusters=clusters,
        exact_p_values=exact,
        tests=tests,
        notes=[*_notes_on_frames(runs, names), *_notes_on_tests(measures, known, clusters, tests)],
    )


def _shared_measures(runs: Sequence[Run], columns: Sequence[str] | None) -> tuple[Measure, ...]:
    """The measures of these keys that all runs have; the main ones for None."""
    shared = set.intersection(*({measure.key for measure in run.measures} for run in runs))
    measures = [measure for measure in runs[0].measures if measure.key in shared]
    main = tuple(measure for measure in measures if measure.main)
    return main if columns is None and main else choose_measures(measures, columns)


def _means(
    keys: Sequence[str], frames: Iterable[Iterable[float | None]]
) -> dict[str, float | None]:
    """The means of each frame's values, by their keys."""
    return FrameMeans(dict(zip(keys, frame, strict=True)) for frame in frames).means()


def _gains(
    values: NDArray[np.float64],
    means: Sequence[dict[str, float | None]],
    measures: Sequence[Measure],
    clusters: Clusters,
) -> tuple[list[dict[str, Gain]], bool]:
    """The gain of each run but the first by measure, and whether the p-values are exact.

    The values are (runs, frames, measures), NaN where a frame lacks a measure in any run.
    """
    better = np.array([measure.sign for measure in measures], np.float64)
    first, *others = (np.array([*mean.values()], np.float64) for mean in means)
    rows, exact = [], True
    for other, mean in zip(values[1:], others, strict=True):
        ends = interval(lambda a, b: gain(a, b, better), (values[0], other), clusters)
        p_values, exact = swap_p_values(values[0], other, clusters, PERMUTATIONS, SEED)
        rows.append([gain(first, mean, better), *ends, mean - first, p_values])
    of_runs = np.array(rows)  # (runs − 1, 5, measures)
    of_runs = np.concatenate([of_runs, holm(of_runs[:, 4:])], axis=1)
    return [
        {
            measure.key: Gain(*(None if math.isnan(v) else v for v in row))
            for measure, row in zip(measures, of_run, strict=True)
        }
        for of_run in of_runs.transpose(0, 2, 1).tolist()
    ], exact


def _check_rules(first: Run, other: Run) -> None:
    for rule in sorted({*first.scoring, *other.scoring}):
        own, others = first.scoring.get(rule), other.scoring.get(rule)
        if own != others:
            raise InputError(
                f"{first.path} and {other.path} were scored by different rules ({rule} {own} and"
                f" {others}); score both by one protocol"
            )


def _names(runs: Sequence[Run]) -> list[str]:
    """The runs' own names, else those of the innermost folders that tell the runs apart."""
    paths = ((run.name, *Path(run.path).parts[-2::-1]) for run in runs)
    for names in zip_longest(*paths):
        if None not in names and len({*names}) == len(runs):
            return list(names)
    return [f"{run.name} ({number})" for number, run in enumerate(runs, start=1)]


def _notes_on_frames(runs: Sequence[Run], names: Sequence[str]) -> Iterator[str]:
    """Warnings of frames and pixels that not all runs scored."""
    for run in runs:
        if unshared := [name for name in run.scores if name not in set(names)]:
            yield (
                f"warning: {count_of(len(unshared), 'frame')} of {run.path} not scored in all runs,"
                f" left out: {some_names(unshared)}"
            )
    counts = {name: {run.counts(name) for run in runs} for name in names}
    other_truth = [name for name, of in counts.items() if len({known for _, known in of}) > 1]
    if other_truth:
        yield (
            f"warning: {count_of(len(other_truth), 'frame')} with another number of pixels with"
            " ground truth in another run, so the runs were not scored on the same:"
            f" {some_names(other_truth)}"
        )
    elif any(len(of) > 1 for of in counts.values()):
        shares = ", ".join(f"{run.coverage(names):.2%} in {run.path}" for run in runs)
        yield (
            f"warning: coverage differs ({shares}), and a run that leaves hard pixels empty looks"
            " better; this is no ranking"
        )


def _notes_on_tests(
    measures: Sequence[Measure], known: NDArray[np.bool_], clusters: Clusters, tests: int
) -> Iterator[str]:
    """Measures that frames lack, and whether frames are too dependent or too few to conclude."""
    for measure, has in zip(measures, known.T, strict=True):
        if not has.all():
            of = f"{has.sum():,} of {len(has):,} frames"
            yield f"{measure.title}: over {of}; the others lack it in a run"
    yield from clusters.notes()
    smallest = 2.0 ** (1 - clusters.count)
    if len(known) > 1 and tests * smallest >= ALPHA:
        few = f"; there is no interval below {MIN_CLUSTERS}" * (clusters.count < MIN_CLUSTERS)
        yield (
            f"warning: {clusters.describe()} are too few independent ones to conclude anything from"
            f" {tests} tests: the smallest possible p is {smallest:.2g}, adjusted"
            f" {min(1.0, tests * smallest):.2g}{few}"
        )


def read_run(text: str) -> Run:
    """Returns the run in a file, or in the summary of a batch's folder.

    A run is the output of `pnpdepth eval --json`, or a batch's summary.

    Args:
        text: The path; `FILE:before` means the prediction that a refinement started from, without
            it its result is meant.

    Raises:
        FileFormatError: For a file without scores.
        UsageError: For `:before` of an evaluation.
    """
    # The file, and which side of the refinement.
    path, stage = Path(text), AFTER
    start, colon, end = text.rpartition(":")
    if colon and end in (BEFORE, AFTER) and not path.exists():
        path, stage = Path(start), end
    path = path / _SUMMARY if path.is_dir() else path
    name = path.resolve().parent.name if path.name == _SUMMARY else path.stem
    content = read_json(path)
    if content.get("command") == "eval" and stage == BEFORE:
        raise UsageError(f"{path} is of eval, which has no before; leave out :before")
    # The frames with scores, and the measures that all of them have.
    try:
        records = [FrameRecord.from_json(entry, path) for entry in content.get("frames") or ()]
        frames = {f.name: f for f in records if f.status != "failed" and GT in f.errors}
        scores = {name: frame.errors[GT][stage] for name, frame in frames.items()}
        if not scores:
            raise ValueError("no frame has scores")
        measures = [Measure.from_json(entry) for entry in content.get("measures", ())] or MEASURES
        return Run(
            name=f"{name}:before" if stage == BEFORE else name,
            path=text,
            measures=[m for m in measures if all(m.key in own for own in scores.values())],
            scoring=dict(content.get("scoring") or scoring_of(find_protocol("paper"))),
            scores=scores,
            before={name: frame.errors[GT].get(BEFORE, {}) for name, frame in frames.items()},
            groups={name: frame.group for name, frame in frames.items()},
            varied={str(key): str(value) for key, value in content.get("varied", {}).items()},
        )
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise FileFormatError(
            f"{path} does not hold scores as pnpdepth writes them ({one_line(repr(error))}); give"
            " what eval --json printed, or the summary of a batch with ground truth"
        ) from error


def comparison_table(comparison: Comparison) -> Table:
    """Returns a row for each measure and run; all runs but the first have gain and p."""
    first, *others = comparison.runs
    rows: list[list[str]] = []
    for measure in comparison.measures:
        rows.append([measure.heading, first.name, measure.text(first.mean[measure.key]), *"––––"])
        for run in others:
            found, p = run.gains[measure.key], run.gains[measure.key].p_adjusted
            style: Style = "good" if (found.percent or 0) > 0 else "bad"
            percents = (found.percent, found.low_percent, found.high_percent)
            percent, *ends = ("–" if value is None else f"{value:+.2f}" for value in percents)
            rows.append([
                measure.heading,
                run.name,
                measure.text(run.mean[measure.key]),
                Cell(percent, style if p is not None and p < ALPHA else "dim"),
                *ends,
                "–" if p is None else f"{p:.4f}",
            ])  # fmt: skip
    # What was tested, in the title.
    swaps = "all" if comparison.exact_p_values else f"{PERMUTATIONS:,} random"
    return Table(
        title=(
            f"{count_of(len(comparison.frames), 'shared frame')}; gains in per cent of the error of"
            f" {first.name}, positive is better; intervals (95 %) and p-values, from {swaps}"
            f" swaps, {_describe_tests(comparison)}"
        ),
        columns=["measure", "run", "mean", "gain [%]", "low", "high", "p"],
        rows=rows,
    )


def methods_table(comparison: Comparison) -> Table:
    """Returns a row for each run and a column for each measure, the best of a column in bold.

    Stars mark where a run differs from the first significantly.
    """
    runs = comparison.runs
    rows: list[list[str]] = [[run.name] for run in runs]
    for measure in comparison.measures:
        means = [run.mean[measure.key] for run in runs]
        pick = max if measure.better == "higher" else min
        best = measure.text(pick((mean for mean in means if mean is not None), default=None))
        for row, run, mean in zip(rows, runs, means, strict=True):
            p = run.gains[measure.key].p_adjusted if run.gains else None
            stars = "*" * sum(p is not None and p < limit for limit in _STARS)
            text = measure.text(mean)
            is_best = mean is not None and text == best and measure.sign != 0
            row.append(Cell(text + stars, "bold" if is_best else ""))
    return Table(
        title=(
            f"means over {count_of(len(comparison.frames), 'frame')}, the best in bold; *, **, ***:"
            f" differs from {runs[0].name} with p < 0.05, 0.01, 0.001 {_describe_tests(comparison)}"
        ),
        columns=["", *comparison.measures],
        rows=rows,
    )


def _describe_tests(comparison: Comparison) -> str:
    others, measures = len(comparison.runs) - 1, len(comparison.measures)
    tests = count_of(measures, "measure") + (f" of {others} runs" if others > 1 else "")
    tested = f"over {comparison.clusters.describe()}, p adjusted for {tests} (Holm)"
    return tested + WITHOUT_SPARSE * bool(comparison.scoring.get("exclude_sparse"))
