"""`pnpdepth compare`: runs on the same frames side by side, and whether they really differ."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import zip_longest
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.commands.evaluation.pairing import some_names
from pnpdepth_cli.commands.evaluation.request import scoring_of
from pnpdepth_cli.commands.statistics import (
    MIN_CLUSTERS,
    Clusters,
    find_clusters,
    gain,
    holm,
    interval,
    swap_p_values,
)
from pnpdepth_cli.dataset.frame_files import groups_by_name
from pnpdepth_cli.errors import FileFormatError, InputError, UsageError
from pnpdepth_cli.io.file_bytes import one_line
from pnpdepth_cli.io.record import plain, read_json
from pnpdepth_cli.measures import MEASURES, FrameMeans, Measure, chosen_measures
from pnpdepth_cli.protocols import find_protocol

ALPHA = 0.05
PERMUTATIONS, SEED = 10_000, 0
"""Most swaps of the permutation test, and their seed where not all are tried."""
_SUMMARY = "summary.json"
_STAGES = ("before", "after")
_GAIN = ("percent", "low_percent", "high_percent", "difference", "p_value", "p_adjusted")


class RunFrame(NamedTuple):
    """A scored frame of a run."""

    values: Mapping[str, float]
    """By measure; NaN for null."""
    before: Mapping[str, float]
    """The same before refinement; empty for an evaluation."""
    pixels: int
    """Scored ones."""
    known: int
    """Pixels with ground truth."""
    group: str


class Run(NamedTuple):
    """The scored frames of one saved run, by name."""

    name: str
    """That of the folder, or of the file without its ending."""
    path: str
    measures: Sequence[Measure]
    scoring: dict[str, Any]
    frames: dict[str, RunFrame]
    varied: dict[str, str]
    """Options that `batch --vary` varied, with their values; empty for other runs."""

    def coverage(self, names: Sequence[str]) -> float:
        """Returns the fraction of the ground truth of these frames that is scored."""
        frames = [self.frames[name] for name in names]
        known = sum(frame.known for frame in frames)
        return sum(frame.pixels for frame in frames) / known if known else math.nan


def compare(paths: Sequence[str], *, columns: Sequence[str] | None = None) -> dict[str, Any]:
    """Returns the runs on the frames that all of them scored, compared with the first.

    A measure that a frame lacks in one of the runs is averaged and tested over the other frames.
    `runs` has the means of each run, `gains` those of each but the first: in per cent of the first
    run's mean with the ends of the 95 % interval, and as a difference; positive per cents are
    better. `p_value` is that of no difference, `p_adjusted` by the number of tests, of all
    measures and runs. None is a value that there is not, as for a single frame.

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
    for run in runs[1:]:
        _check_rules(runs[0], run)
    # the frames and the measures that all runs have
    names = tuple(name for name in runs[0].frames if all(name in run.frames for run in runs))
    if not names:
        first, other = (some_names(run.frames) or "none" for run in (runs[0], runs[-1]))
        raise InputError(f"the runs have no scored frame in common: {first}; and {other}")
    measures = _shared_measures(runs, columns)
    keys = [measure.key for measure in measures]
    values = np.array(
        [[[run.frames[n].values.get(k, math.nan) for k in keys] for n in names] for run in runs]
    )
    known = np.isfinite(values).all(axis=0)
    values = np.where(known, values, math.nan)  # (runs, frames, measures)
    # the tests, over frames that count as independent
    groups = [runs[0].frames[name].group for name in names]
    differences = np.concatenate(list(values[1:] - values[0]), axis=1)
    clusters = find_clusters(groups, differences)
    gains, exact = _gains(values, measures, clusters)
    tests = len(gains) * len(measures)
    record = {
        "command": "compare",
        "frames": names,
        "measures": [measure.to_json() for measure in measures],
        "scoring": runs[0].scoring,
        "runs": [
            {
                "name": name,
                "path": run.path,
                "mean": _means(keys, of_run),
                "before": FrameMeans(
                    {key: run.frames[frame].before.get(key) for key in keys} for frame in names
                ).means(),
                "varied": run.varied,
                "coverage": run.coverage(names),
            }
            for name, run, of_run in zip(_names(runs), runs, values, strict=True)
        ],
        "gains": gains,
        "clusters": {"count": clusters.count, "unit": clusters.unit},
        "exact_p_values": exact,
        "permutations": PERMUTATIONS,
        "tests": tests,
        "notes": [
            *_notes(runs, names),
            *_lacking(measures, known),
            *clusters.notes(),
            *_cluster_notes(clusters, len(names), tests),
        ],
    }
    result: dict[str, Any] = plain(record)
    return result


def _shared_measures(runs: Sequence[Run], columns: Sequence[str] | None) -> tuple[Measure, ...]:
    """The measures of these keys that all runs have; the main ones for None."""
    shared = set.intersection(*({measure.key for measure in run.measures} for run in runs))
    measures = tuple(measure for measure in runs[0].measures if measure.key in shared)
    main = tuple(measure for measure in measures if measure.main)
    return main if columns is None and main else chosen_measures(measures, columns)


def _means(keys: Sequence[str], values: NDArray[np.float64]) -> dict[str, float | None]:
    return FrameMeans(dict(zip(keys, frame, strict=True)) for frame in values.tolist()).means()


def _gains(
    values: NDArray[np.float64], measures: Sequence[Measure], clusters: Clusters
) -> tuple[list[dict[str, dict[str, float]]], bool]:
    """The gain of each run but the first by measure, and whether the p-values are exact.

    Args:
        values: (runs, frames, measures), NaN where a frame lacks a measure.
        measures: Of the last axis.
        clusters: Of the frames.
    """
    keys = [measure.key for measure in measures]
    better = np.array([measure.sign for measure in measures], np.float64)
    first, *others = values
    means = [np.array([*_means(keys, of_run).values()], np.float64) for of_run in values]
    rows, exact = [], True
    for other, mean in zip(others, means[1:], strict=True):
        ends = interval(lambda a, b: gain(a, b, better), (first, other), clusters)
        p_values, exact = swap_p_values(first, other, clusters, PERMUTATIONS, SEED)
        rows.append([gain(means[0], mean, better), *ends, mean - means[0], p_values])
    of_runs = np.array(rows)  # (runs − 1, 5, measures)
    of_runs = np.concatenate([of_runs, holm(of_runs[:, 4:])], axis=1)
    return [
        {key: dict(zip(_GAIN, row, strict=True)) for key, row in zip(keys, rows, strict=True)}
        for rows in of_runs.transpose(0, 2, 1).tolist()
    ], exact


def _check_rules(first: Run, other: Run) -> None:
    differing = [
        f"{rule} {first.scoring.get(rule)} and {other.scoring.get(rule)}"
        for rule in sorted({*first.scoring, *other.scoring})
        if first.scoring.get(rule) != other.scoring.get(rule)
    ]
    if differing:
        raise InputError(
            f"{first.path} and {other.path} were scored by different rules"
            f" ({'; '.join(differing)}); score both by one protocol"
        )


def _names(runs: Sequence[Run]) -> list[str]:
    """Their own names, or else those of the innermost folders that tell the runs apart."""
    paths = ((run.name, *Path(run.path).parts[-2::-1]) for run in runs)
    for names in zip_longest(*paths):
        if None not in names and len({*names}) == len(runs):
            return list(names)
    return [f"{run.name} ({number})" for number, run in enumerate(runs, start=1)]


def _notes(runs: Sequence[Run], names: Sequence[str]) -> list[str]:
    """Warnings of frames and pixels that not all runs scored."""
    lines = []
    for run in runs:
        if unshared := [name for name in run.frames if name not in set(names)]:
            lines.append(
                f"warning: {len(unshared):,} frames of {run.path} are not scored in all runs and"
                f" left out: {some_names(unshared)}"
            )
    frames = {name: [run.frames[name] for run in runs] for name in names}
    if other_truth := [name for name, of in frames.items() if len({f.known for f in of}) > 1]:
        lines.append(
            f"warning: {len(other_truth):,} frames have another number of pixels with ground truth"
            f" in another run, so the runs were not scored on the same: {some_names(other_truth)}"
        )
    elif any(len({frame.pixels for frame in of}) > 1 for of in frames.values()):
        shares = ", ".join(f"{run.coverage(names):.2%} in {run.path}" for run in runs)
        lines.append(
            f"warning: coverage differs ({shares}), and a run that leaves hard pixels empty looks"
            " better; this is no ranking"
        )
    return lines


def _lacking(measures: Sequence[Measure], known: NDArray[np.bool_]) -> list[str]:
    """A line for each measure that some frames lack."""
    return [
        f"{measure.title}: over {has.sum():,} of {len(has):,} frames; the others lack it in a run"
        for measure, has in zip(measures, known.T, strict=True)
        if not has.all()
    ]


def _cluster_notes(clusters: Clusters, frames: int, tests: int) -> list[str]:
    """A warning where the frames are too dependent, or too few, to conclude anything."""
    smallest = 2.0 ** (1 - clusters.count)
    if frames == 1 or tests * smallest < ALPHA:
        return []
    adjusted = min(1.0, tests * smallest)
    return [
        f"warning: {clusters.describe()} are too few independent ones to conclude anything from"
        f" {tests} tests: the smallest possible p is {smallest:.2g}, adjusted {adjusted:.2g}"
        + ("" if clusters.count >= MIN_CLUSTERS else f"; there is no interval below {MIN_CLUSTERS}")
    ]


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
    path, stage = Path(text), "after"
    start, colon, end = text.rpartition(":")
    if colon and end in _STAGES and not path.exists():
        path, stage = Path(start), end
    path = path / _SUMMARY if path.is_dir() else path
    record, name = read_json(path), path.stem
    if path.name == _SUMMARY:
        name = path.resolve().parent.name
    if record.get("command") == "eval" and stage == "before":
        raise UsageError(f"{path} is of eval, which has no before; leave out :before")
    try:
        frames = _scored_frames(record["frames"], stage)
        measures = [Measure.from_json(entry) for entry in record.get("measures", ())]
        return Run(
            name=f"{name}:before" if stage == "before" else name,
            path=text,
            measures=[
                measure
                for measure in measures or MEASURES
                if all(measure.key in frame.values for frame in frames.values())
            ],
            scoring=dict(record.get("scoring") or scoring_of(find_protocol("paper"))),
            frames=frames,
            varied={str(key): str(value) for key, value in record.get("varied", {}).items()},
        )
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        fact = one_line(repr(error))
        raise FileFormatError(
            f"{path} does not hold scores as pnpdepth writes them ({fact}); give what eval --json"
            " printed, or the summary of a batch with ground truth"
        ) from error


def _scored_frames(entries: Sequence[Mapping[str, Any]], stage: str) -> dict[str, RunFrame]:
    """The frames with scores by name; their counts stand among the scores or beside them."""
    scored = [entry for entry in entries if entry.get("scores") is not None]
    if not scored:
        raise ValueError("no frame has scores")
    frames = {}
    groups = groups_by_name([entry["name"] for entry in scored])
    for entry, group in zip(scored, groups, strict=True):
        scores = entry["scores"]
        counts = {**entry, **scores[stage]}
        pixels, coverage = counts["pixels"], counts["coverage"]
        frames[entry["name"]] = RunFrame(
            values=_numbers(scores[stage]),
            before=_numbers(scores.get("before", {})),
            pixels=round(pixels),
            known=round(counts.get("known", pixels / coverage if coverage else 0)),
            group=str(entry.get("group", group)),
        )
    return frames


def _numbers(values: Mapping[str, Any]) -> dict[str, float]:
    return {key: math.nan if value is None else float(value) for key, value in values.items()}
