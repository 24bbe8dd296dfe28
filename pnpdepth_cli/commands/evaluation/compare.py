"""`pnpdepth compare`: runs on the same frames side by side, and whether they really differ."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.commands.evaluation.eval_request import WITHOUT_SPARSE, scoring_of
from pnpdepth_cli.commands.evaluation.pairing import some_names
from pnpdepth_cli.commands.statistics import (
    Clusters,
    find_clusters,
    gain,
    holm,
    interval,
    swap_p_value,
)
from pnpdepth_cli.commands.tables import Cell, Style, Table, count_of
from pnpdepth_cli.dataset.frame_files import groups_by_name
from pnpdepth_cli.dataset.frame_record import FrameRecord, Scores
from pnpdepth_cli.errors import FileFormatError, InputError, UsageError
from pnpdepth_cli.io.file_bytes import one_line, plain, read_json
from pnpdepth_cli.measures import COVERAGE, MEASURES, Measure, choose_measures, frame_means
from pnpdepth_cli.protocols import find_protocol
from pnpdepth_cli.stages import AFTER, BEFORE, GT

Means = dict[str, float | None]
"""Means by the key of their measure; None where no frame has it."""
ALPHA = 0.05
_SUMMARY = "summary.json"
_STARS = (0.05, 0.01, 0.001)


@dataclass(frozen=True, kw_only=True)
class Run:
    """The scored frames of one saved run."""

    name: str
    """Name of the folder, or of the file without its ending."""
    path: str
    measures: list[Measure]
    """Measures that all frames have."""
    scoring: dict[str, Any]
    frames: dict[str, FrameRecord]
    """The frames with scores, by name."""
    stage: str
    """BEFORE or AFTER: the depth that is compared."""
    varied: dict[str, str]
    """Options that `batch --vary` varied, with their values; empty for other runs."""

    def scores(self, frame: str, stage: str = "") -> Scores:
        """Returns the scores of a frame at that stage, else at the run's own."""
        return self.frames[frame].errors[GT].get(stage or self.stage, {})

    def means(self, frames: Sequence[str], keys: Sequence[str], stage: str = "") -> Means:
        """Returns the means of these values over these frames at that stage, else its own."""
        scores = (self.scores(frame, stage) for frame in frames)
        return frame_means({key: own.get(key) for key in keys} for own in scores)


@dataclass(frozen=True, kw_only=True)
class Gain:
    """How much better a run is than the first by one measure; NaN for what there is not."""

    percent: float
    """Gain in per cent of the first run's mean; positive is better."""
    low_percent: float
    """Lower end of the 95 % interval of `percent`."""
    high_percent: float
    p_value: float
    """Probability of such a difference between equal runs."""
    p_adjusted: float
    """The same by the number of tests, of all measures and runs."""


@dataclass(frozen=True, kw_only=True)
class ComparedRun:
    """A run on the frames that all runs scored."""

    name: str
    path: str
    mean: Means
    before: Means
    """The mean before refinement, where the run has it."""
    varied: dict[str, str]
    coverage: float | None
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
    notes: list[str]

    def to_json(self) -> dict[str, Any]:
        """Returns what `--json` prints."""
        measures = [measure.to_json() for measure in self.measures]
        own = {"clusters": self.clusters.to_json(), "measures": measures}
        result: dict[str, Any] = plain({"command": "compare", **vars(self), **own})
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
    names, measures = _shared(runs, columns)
    keys = [measure.key for measure in measures]
    scores = [[[*map(run.scores(name).get, keys)] for name in names] for run in runs]
    values = np.array(scores, np.float64)  # (runs, frames, measures)
    known = np.asarray(np.isfinite(values).all(axis=0))
    values[:, ~known] = math.nan
    # the tests, over frames that count as independent
    by_name = zip(names, groups_by_name(names), strict=True)
    groups = [runs[0].frames[name].group or group for name, group in by_name]
    clusters = find_clusters(groups, np.concatenate(list(values[1:] - values[0]), axis=1))
    means = [
        frame_means(dict(zip(keys, row, strict=True)) for row in of_run)
        for of_run in values.tolist()
    ]
    gains = _gains(values, means, measures, clusters)
    run_names = [run.name for run in runs]
    if len({*run_names}) < len(runs):
        run_names = [run.path for run in runs]
    compared = zip(runs, run_names, means, [{}, *gains], strict=True)
    return Comparison(
        frames=names,
        measures=measures,
        scoring=runs[0].scoring,
        runs=tuple(
            ComparedRun(
                name=name,
                path=run.path,
                mean=mean,
                before=run.means(names, keys, BEFORE),
                varied=run.varied,
                coverage=run.means(names, [COVERAGE.key])[COVERAGE.key],
                gains=of_first,
            )
            for run, name, mean, of_first in compared
        ),
        clusters=clusters,
        notes=[*_notes(runs, names, measures, known, clusters)],
    )


def _shared(
    runs: Sequence[Run], columns: Sequence[str] | None
) -> tuple[tuple[str, ...], tuple[Measure, ...]]:
    """The frames and the measures that all runs have. InputError if they cannot be compared."""
    first = runs[0]
    for run in runs[1:]:
        for rule in sorted({*first.scoring, *run.scoring}):
            own, others = first.scoring.get(rule), run.scoring.get(rule)
            if own != others:
                raise InputError(
                    f"{first.path} and {run.path} were scored by different rules ({rule} {own} and"
                    f" {others}); score both by one protocol"
                )
    names = tuple(name for name in first.frames if all(name in run.frames for run in runs))
    if not names:
        own, other = (some_names(run.frames) or "none" for run in (first, runs[-1]))
        raise InputError(f"the runs have no scored frame in common: {own}; and {other}")
    shared = set.intersection(*({measure.key for measure in run.measures} for run in runs))
    every = [measure for measure in first.measures if measure.key in shared]
    return names, choose_measures(every, columns or [each.key for each in every if each.main])


def _gains(
    values: NDArray[np.float64],
    means: Sequence[Means],
    measures: Sequence[Measure],
    clusters: Clusters,
) -> list[dict[str, Gain]]:
    """The gain of each run but the first by measure, of values (runs, frames, measures)."""
    first, *others = values.transpose(0, 2, 1)
    p_values = [
        [swap_p_value(*pair, clusters) for pair in zip(first, other, strict=True)]
        for other in others
    ]
    adjusted = holm(np.array(p_values)).tolist()
    gains: list[dict[str, Gain]] = [{} for _ in others]
    for run, place in np.ndindex(len(others), len(measures)):
        measure = measures[place]
        change = functools.partial(gain, sign=measure.sign)
        before, after = np.array([each[measure.key] for each in (means[0], means[run + 1])], float)
        low, high = interval(change, (first[place], others[run][place]), clusters)
        gains[run][measure.key] = Gain(
            percent=float(change(before, after)),
            low_percent=low,
            high_percent=high,
            p_value=p_values[run][place],
            p_adjusted=adjusted[run][place],
        )
    return gains


def _notes(
    runs: Sequence[Run],
    names: Sequence[str],
    measures: Sequence[Measure],
    known: NDArray[np.bool_],
    clusters: Clusters,
) -> Iterator[str]:
    """What not all runs scored, and whether frames are too dependent or too few to conclude."""
    # Frames, pixels and measures that not all runs have.
    for run in runs:
        if unshared := [name for name in run.frames if name not in names]:
            yield (
                f"warning: {count_of(len(unshared), 'frame')} of {run.path} not scored in all runs,"
                f" left out: {some_names(unshared)}"
            )
    pixels = (len({run.scores(name).get("pixels") for run in runs}) for name in names)
    if others := sum(count > 1 for count in pixels):
        means = (run.means(names, [COVERAGE.key])[COVERAGE.key] for run in runs)
        shares = ", ".join(map(COVERAGE.text, means))
        yield (
            f"warning: {count_of(others, 'frame')} with other numbers of scored pixels in the runs"
            f" (coverage: {shares}), and a run that leaves hard pixels empty looks better; this is"
            " no ranking"
        )
    for measure, has in zip(measures, known.T, strict=True):
        if not has.all():
            of = f"{has.sum():,} of {len(has):,} frames"
            yield f"{measure.title}: over {of}; the others lack it in a run"
    # The frames that count as independent.
    yield from clusters.notes()
    smallest, tests = 2.0 ** (1 - clusters.count), len(measures) * (len(runs) - 1)
    if len(known) > 1 and tests * smallest >= ALPHA:
        yield (
            f"warning: {clusters.text} are too few independent ones to conclude anything from"
            f" {tests} tests: p is at least {smallest:.2g}, adjusted"
            f" {min(1.0, tests * smallest):.2g}"
        )


def read_run(text: str) -> Run:
    """Returns the run in a file, or in the summary of a batch's folder.

    A run is the output of `pnpdepth eval --json`, or a batch's summary.

    Args:
        text: The path; `FILE:before` means the prediction that a refinement started from.

    Raises:
        FileFormatError: For a file without scores.
    """
    # The file, and which side of the refinement.
    path, stage = Path(text), AFTER
    if text.endswith(f":{BEFORE}") and not path.exists():
        path, stage = Path(text.removesuffix(f":{BEFORE}")), BEFORE
    path = path / _SUMMARY if path.is_dir() else path
    name = path.resolve().parent.name if path.name == _SUMMARY else path.stem
    content = read_json(path)
    # The frames with scores, and the measures that all of them have.
    try:
        records = [FrameRecord.from_json(entry, path) for entry in content.get("frames") or ()]
        frames = {f.name: f for f in records if f.status != "failed" and GT in f.errors}
        scores = [frame.errors[GT][stage] for frame in frames.values()]
        if not scores:
            raise ValueError("no frame has scores")
        measures = [Measure(**entry) for entry in content.get("measures", ())] or MEASURES
        return Run(
            name=f"{name}:before" if stage == BEFORE else name,
            path=text,
            measures=[m for m in measures if all(m.key in own for own in scores)],
            scoring=dict(content.get("scoring") or scoring_of(find_protocol("paper"))),
            frames=frames,
            stage=stage,
            varied={str(key): str(value) for key, value in content.get("varied", {}).items()},
        )
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise FileFormatError(
            f"{path} does not hold scores as pnpdepth writes them ({one_line(repr(error))}); give"
            " what eval --json printed, or the summary of a batch with ground truth"
        ) from error


def comparison_table(comparison: Comparison) -> Table:
    """Returns a row for each measure and run; all runs but the first have gain and p."""
    rows: list[list[str]] = []
    for measure in comparison.measures:
        for run in comparison.runs:
            row = [measure.heading, run.name, measure.text(run.mean[measure.key])]
            if not run.gains:
                rows.append([*row, *"––––"])
                continue
            found = run.gains[measure.key]
            percents = (found.percent, found.low_percent, found.high_percent)
            texts = ["–" if math.isnan(value) else f"{value:+.2f}" for value in percents]
            style: Style = "dim"
            if found.p_adjusted < ALPHA:
                style = "good" if found.percent > 0 else "bad"
            p = "–" if math.isnan(found.p_adjusted) else f"{found.p_adjusted:.4f}"
            rows.append([*row, Cell(texts[0], style), *texts[1:], p])
    return Table(
        title=(
            f"{count_of(len(comparison.frames), 'shared frame')}; gains in per cent of the error of"
            f" {comparison.runs[0].name}, positive is better; intervals (95 %) and p-values"
            f" {_describe_tests(comparison)}"
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
            p = run.gains[measure.key].p_adjusted if run.gains else math.nan
            text, is_known = measure.text(mean), mean is not None and measure.sign != 0
            stars = "*" * sum(p < limit for limit in _STARS)
            row.append(Cell(text + stars, "bold" if is_known and text == best else ""))
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
    tested = f"over {comparison.clusters.text}, p adjusted for {tests} (Holm)"
    return tested + WITHOUT_SPARSE * bool(comparison.scoring.get("exclude_sparse"))
