"""`pnpdepth compare`: runs on the same frames side by side, and whether they really differ."""

from __future__ import annotations

import functools
import math
import os
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.commands.requests import check_outputs
from pnpdepth_cli.commands.requests.eval_request import WITHOUT_SPARSE, EvalRequest
from pnpdepth_cli.commands.shared import statistics
from pnpdepth_cli.commands.shared.statistics import Clusters, find_clusters
from pnpdepth_cli.commands.shared.tables import Style, Table, count_of, some_names
from pnpdepth_cli.dataset.frame_files import groups_of
from pnpdepth_cli.dataset.frame_record import FrameRecord
from pnpdepth_cli.errors import InputError, UsageError
from pnpdepth_cli.io.atomic import atomic_path
from pnpdepth_cli.io.file_bytes import one_line, plain, read_json
from pnpdepth_cli.measures import (
    AFTER,
    BEFORE,
    COVERAGE,
    GT,
    MEASURES,
    Measure,
    choose_measures,
    frame_means,
)
from pnpdepth_cli.settings import OF_UPDATES

Means = dict[str, float | None]
"""Means by the key of their measure; None where no frame has it."""
Rows = list[list[int | float | None]]
"""The values of a frame a row."""
ALPHA = 0.05
"""Adjusted p below which a difference counts."""
_SUMMARY = "summary.json"
_PAPER = EvalRequest(prediction=Path(), ground_truth=Path())
"""How batches score."""
_STARS = (0.05, 0.01, 0.001)
"""p below which a cell has one, two, three stars."""
_CHANGING = {".png": "Software", ".svg": "Date", ".pdf": "CreationDate"}
"""Metadata that a plot lacks, by its suffix, so that the same runs give the same bytes."""
_SIDE_INCHES = 3.2
"""Side of a panel of a plot."""
_SEED = "seed"
"""An option whose values are draws of the same."""


@dataclass(frozen=True, kw_only=True)
class Run:
    """One saved run."""

    name: str
    """Name of the folder, or of the file without its ending."""
    path: str
    measures: list[Measure]
    """Measures that all frames have."""
    scoring: dict[str, object]
    frames: dict[str, FrameRecord]
    """The scored frames by name; their errors "after" are what is compared."""
    varied: dict[str, str]
    """Options that `batch --vary` varied, with their values; empty for other runs."""

    def rows(self, names: Sequence[str], keys: Sequence[str], stage: str = AFTER) -> Rows:
        """Returns the values of a stage with these keys for each frame; None for what it lacks."""
        scores = (self.frames[name].errors[GT].get(stage, {}) for name in names)
        return [[of_frame.get(key) for key in keys] for of_frame in scores]


@dataclass(frozen=True)
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


_OF_GAIN = [declared.name for declared in fields(Gain)]
"""The columns of a gain."""


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
    """Gains by measure; empty for the reference, which is the first that was given."""


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """Runs on the frames that all of them scored, compared with the first."""

    frames: tuple[str, ...]
    measures: tuple[Measure, ...]
    scoring: dict[str, object]
    runs: tuple[ComparedRun, ...]
    """The runs of a study in the order of its values, others as they were given."""
    clusters: Clusters
    notes: list[str]

    @property
    def reference(self) -> ComparedRun:
        """The run that the others are compared with."""
        return next(run for run in self.runs if not run.gains)

    def to_json(self) -> dict[str, object]:
        """Returns what `--json` prints."""
        measures = [measure.to_json() for measure in self.measures]
        own = {"clusters": self.clusters.to_json(), "measures": measures}
        return {"command": "compare", **plain(vars(self) | own)}


def compare(paths: Sequence[str], *, columns: Sequence[str] | None = None) -> Comparison:
    """Returns the runs on the frames that all of them scored, compared with the first.

    A measure that a frame lacks in one of the runs is averaged and tested over the other frames.
    Runs of a study whose settings give the same result are one.

    Args:
        paths: Outputs of `pnpdepth eval --json`, summaries of batches, or the folders of these; the
            first is the reference. `FILE:before` is the prediction that a refinement started from.
        columns: Keys of the measures to compare by, instead of the main ones.

    Raises:
        UsageError: For fewer than two runs.
        InputError: For a file without scores, or if the runs were scored by different rules or have
            no frame in common.
    """
    if len(paths) < 2:
        raise UsageError("two runs at least are needed to compare; name another one")
    runs, same = _different([_read_run(path) for path in paths])
    if len(runs) < 2:
        raise UsageError(f"{same[0]}; name a run with another result")
    names, measures = _shared(runs, columns)
    keys = [measure.key for measure in measures]
    # the values that all runs have; None becomes NaN
    values = np.array([run.rows(names, keys) for run in runs], np.float64)
    known = np.asarray(np.isfinite(values).all(axis=0))
    values[:, ~known] = math.nan  # (runs, frames, measures)
    # the tests, over frames that count as independent
    groups = groups_of(names, [runs[0].frames[name].group for name in names])
    clusters = find_clusters(groups, np.concatenate(list(values[1:] - values[0]), axis=1))
    means = [_means(of_run.tolist(), keys) for of_run in values]
    gains = [{}, *_gains(values, means, measures, clusters)]
    before = np.array([run.rows(names, keys, BEFORE) for run in runs], np.float64)
    is_unique = len({run.name for run in runs}) == len(runs)
    compared = [
        ComparedRun(
            name=run.name if is_unique else run.path,
            path=run.path,
            mean=mean,
            before=_means(np.where(known, of_run, math.nan).tolist(), keys),
            varied=run.varied,
            coverage=_means(run.rows(names, [COVERAGE.key]), [COVERAGE.key])[COVERAGE.key],
            gains=of_first,
        )
        for run, mean, of_run, of_first in zip(runs, means, before, gains, strict=True)
    ]
    found = Comparison(
        frames=names,
        measures=measures,
        scoring=runs[0].scoring,
        runs=tuple(_in_order(compared)),
        clusters=clusters,
        notes=[],
    )
    return replace(found, notes=[*same, *_notes(runs, found, known)])


def _different(runs: Sequence[Run]) -> tuple[list[Run], list[str]]:
    """The runs without those that repeat an earlier one, and a line on each that was repeated.

    Studies of earlier versions have a run for each step size where z is not updated at all. Such
    runs are one if their scores are the same as well.
    """
    kept = list[Run]()
    repeats = defaultdict[str, list[str]](list)
    for run in runs:
        if run.varied.get("iterations") != "0":
            kept.append(run)
            continue
        effective = {name: text for name, text in run.varied.items() if name not in OF_UPDATES}
        of_effect = replace(run, varied=effective)
        earlier = next((other for other in kept if _is_repeat(of_effect, other)), None)
        if earlier is None:
            kept.append(of_effect)
        else:
            repeats[earlier.path].append(run.path)
    notes = [
        f"listed once, as {path}: {', '.join(others)} gave the same result, since z is not updated"
        for path, others in repeats.items()
    ]
    return kept, notes


def _is_repeat(run: Run, earlier: Run) -> bool:
    """Whether a run has the settings, frames and scores of an earlier one."""
    if run.varied != earlier.varied or run.frames.keys() != earlier.frames.keys():
        return False
    return all(
        record.errors[GT] == earlier.frames[name].errors[GT] for name, record in run.frames.items()
    )


def _in_order(runs: Sequence[ComparedRun]) -> list[ComparedRun]:
    """The runs of `batch --vary` in the order of its values; others as they are."""
    if not all(run.varied for run in runs):
        return [*runs]
    places = [_places(name, runs) for name in dict.fromkeys(n for run in runs for n in run.varied)]
    return sorted(runs, key=lambda run: [place(run) for place in places])


def _places(name: str, runs: Sequence[ComparedRun]) -> Callable[[ComparedRun], float]:
    """A function of a run that says where its value of an option lies; without one, before all."""
    values = [*dict.fromkeys(run.varied[name] for run in runs if name in run.varied)]
    places = _numbers(values) or {value: float(place) for place, value in enumerate(values)}
    return lambda run: places[run.varied[name]] if name in run.varied else -math.inf


def _means(rows: Rows, keys: Sequence[str]) -> Means:
    return frame_means(dict(zip(keys, row, strict=True)) for row in rows)


def _shared(
    runs: Sequence[Run], columns: Sequence[str] | None
) -> tuple[tuple[str, ...], tuple[Measure, ...]]:
    """The frames and the measures that all runs have. InputError if they cannot be compared."""
    first = runs[0]
    for run in runs[1:]:
        for rule in sorted({*first.scoring, *run.scoring}):
            value = first.scoring.get(rule)
            another = run.scoring.get(rule)
            if value != another:
                raise InputError(
                    f"{first.path} and {run.path} were scored by different rules ({rule} {value}"
                    f" and {another}); score both by one protocol"
                )
    names = tuple(name for name in first.frames if all(name in run.frames for run in runs))
    if not names:
        raise InputError(
            f"the runs have no scored frame in common: {some_names(first.frames)}; and"
            f" {some_names(runs[-1].frames)}; compare runs on the same frames"
        )
    shared = set.intersection(*({measure.key for measure in run.measures} for run in runs))
    every = [measure for measure in first.measures if measure.key in shared]
    main = [measure.key for measure in every if measure.main]
    return names, choose_measures(every, columns or main)


def _gains(
    values: NDArray[np.float64],
    means: Sequence[Means],
    measures: Sequence[Measure],
    clusters: Clusters,
) -> Iterator[dict[str, Gain]]:
    """The gains of each run but the first by measure, of values (runs, frames, measures)."""
    # p of each run and measure, and the same adjusted for all of these tests.
    reference, *others = values.transpose(0, 2, 1)
    swap = functools.partial(statistics.swap_p_value, clusters=clusters)
    p_values = np.array([[*map(swap, reference, of_run)] for of_run in others])
    adjusted = statistics.holm(p_values)
    # The gains, with their intervals.
    for run, of_run in enumerate(others):
        gains = {}
        for place, measure in enumerate(measures):
            change = functools.partial(statistics.gain, sign=measure.sign)
            before, after = np.array(
                [means[0][measure.key], means[run + 1][measure.key]], float
            )  # None becomes NaN
            low, high = statistics.interval(change, (reference[place], of_run[place]), clusters)
            gains[measure.key] = Gain(
                percent=float(change(before, after)),
                low_percent=low,
                high_percent=high,
                p_value=float(p_values[run, place]),
                p_adjusted=float(adjusted[run, place]),
            )
        yield gains


def _notes(runs: Sequence[Run], found: Comparison, known: NDArray[np.bool_]) -> Iterator[str]:
    """What not all runs scored, and whether frames are too dependent or too few to conclude."""
    # Frames, pixels and measures that not all runs have.
    for run in runs:
        if unshared := [name for name in run.frames if name not in found.frames]:
            yield (
                f"warning: {count_of(len(unshared), 'frame')} of {run.path} not scored in all runs,"
                f" left out: {some_names(unshared)}"
            )
    pixels = zip(*(run.rows(found.frames, ["pixels"]) for run in runs), strict=True)
    unequal = sum(any(count != counts[0] for count in counts) for counts in pixels)
    if unequal:
        shares = ", ".join(COVERAGE.text(run.coverage) for run in found.runs)
        yield (
            f"warning: {count_of(unequal, 'frame')} with other numbers of scored pixels in the runs"
            f" (coverage: {shares}), and a run that leaves hard pixels empty looks better; this is"
            " no ranking"
        )
    for measure, has in zip(found.measures, known.T, strict=True):
        if not has.all():
            yield (
                f"{measure.title}: over {has.sum():,} of {len(has):,} frames; the others lack it in"
                " a run"
            )
    # The frames that count as independent.
    yield from found.clusters.notes()
    # Each cluster can be swapped or not; swapping all is swapping none.
    smallest = 2.0 ** (1 - found.clusters.count)
    tests = len(found.measures) * (len(runs) - 1)
    if len(known) > 1 and tests * smallest >= ALPHA:
        yield (
            f"warning: {found.clusters.text} are too few independent ones to conclude anything from"
            f" {tests} tests: p is at least {smallest:.2g}, adjusted"
            f" {min(1.0, tests * smallest):.2g}"
        )


def _read_run(text: str) -> Run:
    """The run in a file, or in the summary of a batch's folder."""
    # The file, and which side of the refinement.
    path = Path(text)
    stage = AFTER
    if text.endswith(f":{BEFORE}") and not path.exists():
        path = Path(text.removesuffix(f":{BEFORE}"))
        stage = BEFORE
    path = path / _SUMMARY if path.is_dir() else path
    name = Path(os.path.realpath(path)).parent.name if path.name == _SUMMARY else path.stem
    content = read_json(path)
    # The frames with scores, and the measures that all of them have.
    try:
        records = [FrameRecord.from_json(entry, path) for entry in content.get("frames") or ()]
        scored = [frame for frame in records if frame.status != "failed" and GT in frame.errors]
        scores = [frame.errors[GT][stage] for frame in scored]
        if not scores:
            raise InputError(f"{path}: no frame has scores; refine or evaluate with ground truth")
        measures = [_read_measure(entry) for entry in content.get("measures", ())] or MEASURES
        return Run(
            name=f"{name}:before" if stage == BEFORE else name,
            path=text,
            measures=[m for m in measures if all(m.key in of_frame for of_frame in scores)],
            scoring=dict(content.get("scoring") or _PAPER.scoring),
            frames={
                frame.name: replace(frame, errors={GT: frame.errors[GT] | {AFTER: of_frame}})
                for frame, of_frame in zip(scored, scores, strict=True)
            },
            varied={str(key): str(value) for key, value in content.get("varied", {}).items()},
        )
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise InputError(
            f"{path} does not hold scores as pnpdepth writes them ({one_line(repr(error))}); give"
            " what eval --json printed, or the summary of a batch with ground truth"
        ) from error


def _read_measure(entry: Mapping[str, Any]) -> Measure:
    """The measure of an entry that `Measure.to_json` gave; an error of Python's if it is none."""
    measure = Measure(**entry)
    if not (isinstance(measure.key, str) and measure.heading and measure.text(1.0)):
        raise ValueError(f"{measure.key!r} is no measure")
    return measure


def comparison_table(comparison: Comparison) -> Table:
    """Returns a row for each measure and run; all runs but the first have gain and p."""
    rows: list[list[object]] = []
    for measure in comparison.measures:
        for run in comparison.runs:
            row = [measure.heading, run.name, measure.text(run.mean[measure.key])]
            if not run.gains:
                rows.append([*row, "–", "–", "–", "–"])
                continue
            found = run.gains[measure.key]
            percents = (found.percent, found.low_percent, found.high_percent)
            texts = ["–" if math.isnan(value) else f"{value:+.2f}" for value in percents]
            style: Style = "dim"
            if found.p_adjusted < ALPHA:
                style = "good" if found.percent > 0 else "bad"
            p = "–" if math.isnan(found.p_adjusted) else f"{found.p_adjusted:.4f}"
            rows.append([*row, (texts[0], style), *texts[1:], p])
    frames = count_of(len(comparison.frames), "shared frame")
    gains = f"gains in per cent of the error of {comparison.reference.name}, positive is better"
    tests = f"intervals (95 %) and p-values {_describe_tests(comparison)}"
    return Table(
        title=f"{frames}; {gains}; {tests}",
        columns=["measure", "run", "mean", "gain [%]", "low", "high", "p"],
        rows=rows,
    )


def comparison_values(comparison: Comparison) -> Table:
    """Returns `comparison_table` for programs: keys, numbers in full, nothing for what is none."""
    options = [*dict.fromkeys(name for run in comparison.runs for name in run.varied)]
    rows: list[list[object]] = []
    for measure in comparison.measures:
        for run in comparison.runs:
            row = [measure.key, run.name, *map(run.varied.get, options), run.mean[measure.key]]
            of_run = run.gains.get(measure.key)
            rows.append([*row, *(vars(of_run).values() if of_run else [None] * len(_OF_GAIN))])
    return Table(columns=["measure", "run", *options, "mean", *_OF_GAIN], rows=rows)


def methods_table(comparison: Comparison) -> Table:
    """Returns a row for each run and a column for each measure, the best of a column in bold.

    Stars mark where a run differs from the first significantly.
    """
    runs = comparison.runs
    rows: list[list[object]] = [[run.name] for run in runs]
    for measure in comparison.measures:
        means = [run.mean[measure.key] for run in runs]
        pick = max if measure.better == "higher" else min
        best = measure.text(pick((mean for mean in means if mean is not None), default=None))
        for row, run, mean in zip(rows, runs, means, strict=True):
            p = run.gains[measure.key].p_adjusted if run.gains else math.nan
            text = measure.text(mean)
            is_best = mean is not None and measure.sign != 0 and text == best
            stars = "*" * sum(p < limit for limit in _STARS)
            row.append((text + stars, "bold" if is_best else ""))
    best = f"means over {count_of(len(comparison.frames), 'frame')}, the best in bold"
    marks = f"*, **, ***: differs from {comparison.reference.name} with p < 0.05, 0.01, 0.001"
    return Table(
        title=f"{best}; {marks} {_describe_tests(comparison)}",
        columns=["", *comparison.measures],
        rows=rows,
    )


def _describe_tests(comparison: Comparison) -> str:
    others = len(comparison.runs) - 1
    tests = count_of(len(comparison.measures), "measure")
    if others > 1:
        tests += f" of {others} runs"
    text = f"over {comparison.clusters.text}, p adjusted for {tests} (Holm)"
    if comparison.scoring.get("exclude_sparse"):
        text += WITHOUT_SPARSE
    return text


def plot_comparison(comparison: Comparison, path: Path, *, overwrite: bool = False) -> None:
    """Writes a plot of each measure over a varied option, and of its improvement by refinement.

    Numbers, and of several options the one of most values, lie along the axis; each combination of
    the others is a line. A point is the mean over random seeds, where these vary. The means before
    refinement are dashed; the improvement is in per cent of them.

    Raises:
        UsageError: The runs are not of `batch --vary` with the same options, the suffix is of no
            known format, or matplotlib is not installed.
        OutputError: The file exists and is not to be replaced.
    """
    if path.suffix not in _CHANGING:
        raise UsageError(f"--plot {path}: name a file that ends in {', '.join(_CHANGING)}")
    check_outputs([path], overwrite=overwrite)
    try:
        import matplotlib as mpl
        from matplotlib.figure import Figure
    except ImportError:
        raise UsageError("--plot needs matplotlib: pip install 'pnpdepth[plot]'") from None
    across, positions = _axis(comparison.runs)
    lines = _lines(comparison.runs, across, positions)
    # A column of two panels for each measure.
    measures = comparison.measures
    size = (_SIDE_INCHES * len(measures) + 1, 2 * _SIDE_INCHES)
    with mpl.rc_context({"svg.hashsalt": "pnpdepth", "font.size": 8, "axes.grid": True}):
        figure = Figure(size, layout="constrained", dpi=150)
        panels = figure.subplots(2, len(measures), squeeze=False, sharex=True)
        for measure, above, below in zip(measures, *panels, strict=True):
            for number, (label, line) in enumerate(lines.items()):
                before, after = _along(line, measure)
                improved = statistics.gain(before, after, measure.sign)
                above.plot([*line], before, f"C{number}--", linewidth=0.8)
                above.plot([*line], after, f"C{number}o-", label=label or "after refinement")
                below.plot([*line], improved, f"C{number}o-")
            above.set_ylabel(measure.heading)
            below.set(ylabel=f"improvement of {measure.title} [%]", xlabel=across)
            below.set_xscale("log" if min(positions.values()) > 0 else "linear")
            below.set_xticks([*positions.values()], [*positions])
            below.set_xticks([], minor=True)
        # One legend for all.
        panels[0][0].plot([], "k--", linewidth=0.8, label="before refinement")
        figure.legend(*panels[0][0].get_legend_handles_labels(), loc="outside lower center")
        with atomic_path(path) as temporary:
            metadata = {_CHANGING[path.suffix]: None}
            figure.savefig(temporary, format=path.suffix[1:], metadata=metadata)


Line = dict[float, list[ComparedRun]]
"""The runs of a line by where they lie along the axis, in order; several differ in their seed."""


def _lines(
    runs: Sequence[ComparedRun], across: str, positions: Mapping[str, float]
) -> dict[str, Line]:
    """The lines of a plot by their label: one for each combination of the other options."""
    names = [*dict.fromkeys(_labels(run, across) for run in runs)]
    full = max(map(len, names))
    lines = defaultdict[str, Line](dict)
    for run in sorted(runs, key=lambda run: positions[run.varied[across]]):
        # A run without an option, as it has no effect there, is a point of each of its lines.
        stated = {*_labels(run, across)}
        for labels in names:
            if len(labels) == full and stated <= {*labels}:
                lines[", ".join(labels)].setdefault(positions[run.varied[across]], []).append(run)
    return lines


def _along(line: Line, measure: Measure) -> NDArray[np.float64]:
    """(2, points) the means before and after refinement, in the unit of tables; NaN if unknown."""
    means = []
    for runs in line.values():
        pairs = [[run.before[measure.key], run.mean[measure.key]] for run in runs]
        means.append(np.mean(np.array(pairs, float), axis=0))  # None becomes NaN
    return np.array(means).T * measure.shown_factor


def _axis(runs: Sequence[ComparedRun]) -> tuple[str, dict[str, float]]:
    """The option that lies along the axis, and where its values do: names from 0 on."""
    options = max((tuple(run.varied) for run in runs), key=len)
    if not all({*run.varied} <= {*options} and run.varied for run in runs):
        raise UsageError("--plot needs results of `batch --vary`, all of the same options")
    shared = [name for name in options if all(name in run.varied for run in runs)]
    names = [name for name in shared if name != _SEED] or [_SEED]
    values = {name: [*dict.fromkeys(run.varied[name] for run in runs)] for name in names}
    across = max(values, key=lambda name: (_numbers(values[name]) is not None, len(values[name])))
    places = {value: float(place) for place, value in enumerate(values[across])}
    return across, _numbers(values[across]) or places


def _labels(run: ComparedRun, across: str) -> tuple[str, ...]:
    """The values that tell the run's line from others."""
    others = ((k, value) for k, value in run.varied.items() if k not in (across, _SEED))
    return tuple(f"{k}={value}" for k, value in others)


def _numbers(texts: Sequence[str]) -> dict[str, float] | None:
    """The number that each of the texts is; None if one is none."""
    try:
        return {text: float(text.removesuffix("%")) for text in texts}
    except ValueError:
        return None
