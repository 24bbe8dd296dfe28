"""`pnpdepth compare`: runs on the same frames side by side, and whether they really differ."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path, PurePath
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.commands.evaluation.pairing import some_names
from pnpdepth_cli.commands.evaluation.rules import published
from pnpdepth_cli.commands.evaluation.statistics import (
    LEVEL,
    MIN_CLUSTERS,
    Clusters,
    FrameTable,
    find_clusters,
    gain,
    holm,
    interval,
    swap_p_values,
)
from pnpdepth_cli.errors import FileFormatError, InputError, UsageError
from pnpdepth_cli.io.dataset import groups_by_name
from pnpdepth_cli.io.file_bytes import one_line
from pnpdepth_cli.io.record import plain, read_json
from pnpdepth_cli.measures import MEASURES, Measure, chosen_measures

ALPHA = 0.05
PERMUTATIONS, SEED = 10_000, 0
"""Most swaps of the permutation test, and their seed where not all are tried."""
_STAGES = ("before", "after")
_GAIN = ("percent", "low_percent", "high_percent", "difference", "p_value", "p_adjusted")


class Run(NamedTuple):
    """The scored frames of one saved run, by name."""

    label: str
    """The name of the folder, or that of the file without its ending."""
    path: str
    measures: Sequence[Measure]
    scoring: dict[str, Any]
    frames: dict[str, dict[str, Any]]
    """`values` by measure (NaN for null), those `before` refinement (empty for an evaluation),
    scored `pixels`, `known` pixels of the ground truth (None where the file does not say), and
    `group`."""
    varied: dict[str, str]
    """Options that `batch --vary` varied, with their values; empty for other runs."""

    def coverage(self, names: Sequence[str]) -> float | None:
        """Returns the fraction of the ground truth that is scored; None where files do not say."""
        known = [self.frames[name]["known"] or 0 for name in names]
        if not all(known):
            return None
        return float(sum(self.frames[name]["pixels"] for name in names) / sum(known))


def compare(
    paths: Sequence[str],
    *,
    grouped: bool = True,
    columns: Sequence[str] | None = None,
) -> dict[str, Any]:
    """Returns the runs on the frames that all of them scored, compared with the first.

    A measure that a frame lacks in one of the runs is averaged and tested over the other frames.
    `runs` has the means of each run, `gains` those of each but the first: in per cent of the first
    run's mean with the ends of the 95 % interval, and as a difference; positive per cents are
    better. `p_value` is that of no difference, `p_adjusted` by the number of tests, of all
    measures and runs. None is a
    value that there is not, as for a single frame.

    Args:
        paths: Files as `read_run` takes them; the first is the reference.
        grouped: False if every frame counts as independent.
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
    names = tuple(name for name in runs[0].frames if all(name in run.frames for run in runs))
    if not names:
        first, other = (some_names(run.frames) or "none" for run in (runs[0], runs[-1]))
        raise InputError(f"the runs have no scored frame in common: {first}; and {other}")
    shared = set.intersection(*({m.key for m in run.measures} for run in runs))
    measures = tuple(measure for measure in runs[0].measures if measure.key in shared)
    main = tuple(measure for measure in measures if measure.main)
    measures = main if columns is None and main else chosen_measures(measures, columns)
    keys = [measure.key for measure in measures]
    values = np.array(
        [[[run.frames[n]["values"].get(k, math.nan) for k in keys] for n in names] for run in runs]
    )
    known = np.isfinite(values).all(axis=0)
    differences = np.concatenate(list(values[1:] - values[0]), axis=1)
    groups = [runs[0].frames[name]["group"] for name in names]
    clusters = find_clusters(groups, differences, grouped=grouped)
    tables = [FrameTable.of_frames(np.where(known, of_run, math.nan)) for of_run in values]
    better = np.array([measure.sign for measure in measures], np.float64)
    means, found, exact = [table.mean() for table in tables], [], True
    for table, mean in zip(tables[1:], means[1:], strict=True):
        ends = interval(lambda a, b: gain(a, b, better), (tables[0], table), clusters)
        p_values, exact = swap_p_values(tables[0], table, clusters, PERMUTATIONS, SEED)
        found.append([gain(means[0], mean, better), *ends, mean - means[0], p_values])
    of_runs = np.array(found)  # (runs − 1, 5, measures)
    of_runs = np.concatenate([of_runs, holm(of_runs[:, 4:])], axis=1)
    gains = [
        {key: dict(zip(_GAIN, row, strict=True)) for key, row in zip(keys, rows, strict=True)}
        for rows in of_runs.transpose(0, 2, 1).tolist()
    ]
    record = {
        "command": "compare",
        "frames": names,
        "measures": [measure.to_json() for measure in measures],
        "scoring": runs[0].scoring,
        "runs": [
            {
                "label": label,
                "path": run.path,
                "mean": dict(zip(keys, mean.tolist(), strict=True)),
                "before": _mean_before(run, names, keys),
                "varied": run.varied,
                "coverage": run.coverage(names),
            }
            for label, run, mean in zip(_labels(runs), runs, means, strict=True)
        ],
        "gains": gains,
        "level": LEVEL,
        "clusters": {"count": clusters.count, "unit": clusters.unit},
        "exact_p_values": exact,
        "permutations": PERMUTATIONS,
        "seed": SEED,
        "tests": of_runs[:, 0].size,
        "notes": [
            *_notes(runs, names),
            *_lacking(names, measures, known),
            *_cluster_notes(clusters, len(names), of_runs[:, 0].size),
        ],
    }
    result: dict[str, Any] = plain(record)
    return result


def _mean_before(run: Run, names: Sequence[str], keys: Sequence[str]) -> dict[str, float]:
    """The means of these frames before refinement; NaN where there are none."""
    before = [[run.frames[name]["before"].get(k, math.nan) for k in keys] for name in names]
    mean = FrameTable.of_frames(np.array(before)).mean()
    return dict(zip(keys, mean.tolist(), strict=True))


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


def _labels(runs: Sequence[Run]) -> list[str]:
    """The shortest ends of the paths that tell the runs apart."""
    paths = [PurePath(run.path).with_name(run.label).parts for run in runs]
    for length in range(1, max(map(len, paths)) + 1):
        names = ["/".join(parts[-length:]) for parts in paths]
        if len(set(names)) == len(names):
            return names
    return [f"{run.label} ({number})" for number, run in enumerate(runs, start=1)]


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
    other_truth = [n for n, of in frames.items() if len({f["known"] for f in of} - {None}) > 1]
    if other_truth:
        lines.append(
            f"warning: {len(other_truth):,} frames have another number of pixels with ground truth"
            f" in another run, so the runs were not scored on the same: {some_names(other_truth)}"
        )
    elif any(len({frame["pixels"] for frame in of}) > 1 for of in frames.values()):
        shares = []
        for run in runs:
            share, pixels = run.coverage(names), sum(run.frames[n]["pixels"] for n in names)
            text = f"{pixels:,} pixels" if share is None else f"{share:.2%}"
            shares.append(f"{text} in {run.path}")
        lines.append(
            f"warning: coverage differs ({', '.join(shares)}), and a run that leaves hard pixels"
            " empty looks better; this is no ranking"
        )
    return lines


def _lacking(
    names: Sequence[str], measures: Sequence[Measure], known: NDArray[np.bool_]
) -> list[str]:
    """A line for each set of measures that some frames lack."""
    titles: dict[tuple[str, ...], list[str]] = {}
    for measure, has in zip(measures, known.T, strict=True):
        lacking = tuple(np.array(names, object)[~has])
        titles.setdefault(lacking, []).append(measure.title)
    return [
        f"{', '.join(of)}: over {len(names) - len(lacking):,} frames; {len(lacking):,} lack it in"
        f" a run: {some_names(lacking)}"
        for lacking, of in titles.items()
        if lacking
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

    A run is the output of `pnpdepth eval --json`, a batch's summary, or a refinement's record.

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
    label = path.stem
    if path.is_dir():
        label, path = path.name, path / "summary.json"
    record = read_json(path)
    if record.get("command") == "eval" and stage == "before":
        raise UsageError(f"{path} is of eval, which has no before; leave out :before")
    try:
        read = (
            _evaluated(record) if record.get("command") == "eval" else _refined(record, path, stage)
        )
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        fact = one_line(repr(error))
        raise FileFormatError(
            f"{path} does not hold scores as pnpdepth writes them ({fact}); create it again"
        ) from error
    label = f"{label}:before" if stage == "before" else label
    return Run(label=label, path=text, **read)


def _evaluated(record: Mapping[str, Any]) -> dict[str, Any]:
    """What `eval --json` printed."""
    return {
        "measures": tuple(Measure.from_json(entry) for entry in record["measures"]),
        "scoring": dict(record["protocol"]["scoring"]),
        "frames": {
            str(frame["name"]): {
                "values": _numbers(frame["values"]),
                "before": {},
                "pixels": int(frame["pixels"]),
                "group": str(frame["group"]),
                "known": None if frame["known"] is None else int(frame["known"]),
            }
            for frame in record["frames"]
            if frame["error"] is None
        },
        "varied": {},
    }


def _refined(record: Mapping[str, Any], path: Path, stage: str) -> dict[str, Any]:
    """The scores in a batch's summary, or of the one frame of a record."""
    named: dict[str, str] = {}  # groups that the data set named
    if isinstance(record.get("frames"), list):
        scores = {entry["name"]: entry.get("scores") for entry in record["frames"]}
        named = {entry["name"]: entry["group"] for entry in record["frames"] if "group" in entry}
    else:
        scores = {path.stem: record.get("scores")}
    values = {name: _numbers(each[stage]) for name, each in scores.items() if each is not None}
    if not values:
        raise FileFormatError(
            f"{path} holds no scores; give what eval --json printed, or the summary of a batch or"
            " the record of a refinement with ground truth"
        )
    return {
        "measures": tuple(m for m in MEASURES if all(m.key in each for each in values.values())),
        "scoring": published("paper").scoring(),
        "frames": {
            name: {
                "values": each,
                "before": _numbers(scores[name]["before"]),
                "pixels": round(each["pixels"]),
                "group": named.get(name, group),
                "known": round(each["pixels"] / each["coverage"]) if each["coverage"] else None,
            }
            for (name, each), group in zip(
                values.items(), groups_by_name(list(values)), strict=True
            )
        },
        "varied": {str(name): str(value) for name, value in dict(record.get("varied", {})).items()},
    }


def _numbers(values: Mapping[str, Any]) -> dict[str, float]:
    return {key: math.nan if value is None else float(value) for key, value in dict(values).items()}
