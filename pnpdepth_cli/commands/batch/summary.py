"""The summary of a batch, `summary.json` and `summary.csv`, from the records of its frames."""

from __future__ import annotations

import json
import re
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import IO, Any

import numpy as np

from pnpdepth_cli.commands.statistics import find_clusters
from pnpdepth_cli.dataset.frame_files import groups_by_name
from pnpdepth_cli.dataset.frame_record import FrameRecord, Scores
from pnpdepth_cli.io.atomic import atomic_path
from pnpdepth_cli.io.text_files import plain, write_csv
from pnpdepth_cli.measures import COVERAGE, MEASURES, FrameMeans
from pnpdepth_cli.stages import AFTER, BASES, GT

# a file name that is no UTF-8 has surrogates; JSON escapes them so
TEXT: Any = {"encoding": "utf-8", "errors": "backslashreplace", "newline": "\n"}
CSV, JSON = "summary.csv", "summary.json"

_MEASURED = (*(measure.key for measure in MEASURES), COVERAGE.key)
_MAIN = tuple(measure.key for measure in MEASURES if measure.main)
_RUN_STAGES = ("read", "refine", "write")
_NUMBER = re.compile(r"\d[\d.,]*")
_NAMED = 3
"""Names of frames that are listed with a warning."""


@dataclass(kw_only=True)
class Warned:
    """The frames with one kind of warning."""

    note: str
    """The warning of the first frame."""
    frames: int = 0
    first: list[str] = field(default_factory=list)
    """Names of the first frames."""


@dataclass(frozen=True, kw_only=True)
class BatchSummary:
    """What `summary.json` says of all frames together."""

    command: str = "batch"
    source: str
    output: str
    layout: str
    fixed_by: str
    """The options that fix the method; empty for the default one."""
    settings: dict[str, Any]
    """What decides the results."""
    counts: dict[str, int]
    """Frames: all, done, diverged, failed, pending, with warnings, and worse than linear
    interpolation of those that are compared with it."""
    unit: str
    columns: Sequence[str] | None
    """Measures of the tables. None: all."""
    notes: list[str]
    errors: dict[str, dict[str, Scores]]
    """Means over the frames that have the value, by basis and stage, with their number."""
    weights: dict[str, dict[str, float]]
    """Mean, least and largest weight of each expert of the default method, by name."""
    warnings: list[Warned]
    unsure: list[str]
    """What was guessed of the network and may be wrong."""
    unmatched: list[str]
    """Files that are in no frame."""
    varied: dict[str, str]
    """Options that `--vary` varies, with their values."""
    sequence: dict[str, str | int | None]
    """What frames take over from their neighbours."""


class Tally:
    """Counts records and adds up their errors; the records are not kept."""

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter(
            dict.fromkeys(("done", "diverged", "failed", "with_warnings", "compared", "worse"), 0)
        )
        self.unsure: dict[str, None] = {}
        """What was guessed of the network and may be wrong, each once."""
        self._warnings: dict[str, Warned] = {}  # by the text without its numbers
        self._units: set[str] = set()
        self._weights: defaultdict[str, list[float]] = defaultdict(list)
        # names, groups and main errors of the frames with ground truth
        self._names: list[str] = []
        self._groups: list[str | None] = []
        self._scores: list[list[float | None]] = []
        # by basis and stage
        self._errors: defaultdict[tuple[str, str], FrameMeans] = defaultdict(FrameMeans)

    def add(self, record: FrameRecord) -> None:
        """Adds a record."""
        self.counts[record.status] += 1
        if record.status == "failed":
            return
        self.counts["with_warnings"] += bool(record.warnings)
        for note in record.warnings:
            warned = self._warnings.setdefault(_NUMBER.sub("", note), Warned(note=note))
            warned.frames += 1
            warned.first += [record.name] if len(warned.first) < _NAMED else []
        self.unsure |= dict.fromkeys(n for n in record.notes if ", unsure (" in n)
        self._units.add(record.unit)
        for basis, stages in record.errors.items():
            for stage, scores in stages.items():
                self._errors[basis, stage].add({k: v for k, v in scores.items() if k in _MEASURED})
        for name, weight in record.weights.items():
            self._weights[name].append(weight)
        if GT in record.errors:
            self._names.append(record.name)
            self._groups.append(record.group)
            self._scores.append([record.errors[GT][AFTER].get(key) for key in _MAIN])
        if (worse := record.worse_than_linear) is not None:
            self.counts.update(compared=1, worse=int(worse))

    @property
    def warnings(self) -> list[Warned]:
        """The kinds of warnings."""
        return list(self._warnings.values())

    @property
    def unit(self) -> str:
        """The unit of all depths."""
        return " and ".join(sorted(self._units)) or "m"

    def notes(self) -> list[str]:
        """Returns how many of the frames with ground truth count as independent."""
        by_name = groups_by_name(self._names)
        groups = [own or name for own, name in zip(self._groups, by_name, strict=True)]
        if len(groups) < 2:
            return []
        return find_clusters(groups, np.array(self._scores, np.float64)).notes()

    def errors(self) -> dict[str, dict[str, Scores]]:
        """Returns the means of the errors by basis and stage, with the number of frames."""
        means: dict[str, dict[str, Scores]] = {}
        for (basis, stage), errors in self._errors.items():
            means.setdefault(basis, {})[stage] = {"frames": errors.frames, **errors.means()}
        return means

    @property
    def weights(self) -> dict[str, dict[str, float]]:
        """Mean, least and largest weight of each expert of the default method, by name."""
        return {
            name: {"mean": sum(all_) / len(all_), "least": min(all_), "largest": max(all_)}
            for name, all_ in self._weights.items()
        }


def write_summaries(
    folder: Path,
    summary: BatchSummary,
    lines: IO[str],
    records: Callable[[], Iterable[FrameRecord]],
) -> None:
    """Writes `summary.json`, the summary with the records as its list `frames`, and `summary.csv`.

    Args:
        folder: The folder of the results.
        summary: Summary of all frames.
        lines: A file opened as TEXT, with a record in each line as JSON.
        records: Function that gives the same records.
    """
    text = json.dumps(plain(asdict(summary)), indent=2, ensure_ascii=False, allow_nan=False)
    with atomic_path(folder / JSON) as path, path.open("w", **TEXT) as file:
        file.write(text.removesuffix("\n}") + ',\n  "frames": [')
        lines.seek(0)
        for number, line in enumerate(lines):
            file.write(f"{',' if number else ''}\n    {line.removesuffix(chr(10))}")
        file.write("\n  ]\n}\n")
    measured = list(_error_columns(summary.errors, summary.columns))
    with atomic_path(folder / CSV) as path, path.open("w", **TEXT) as file:
        header = ["name", "status", "message", "points", "held_out_points", "improved_fraction"]
        header += [name for name, *_ in measured]
        header += ["warnings", *(f"seconds_{stage}" for stage in _RUN_STAGES)]
        write_csv(file, header, (list(_cells(record, measured)) for record in records()))


def _error_columns(
    errors: Mapping[str, Mapping[str, Scores]], keys: Sequence[str] | None
) -> Iterator[tuple[str, str, str, str]]:
    """The columns of errors: heading, basis, stage and key, those of ground truth first."""
    shown = _MEASURED if keys is None else (*keys, COVERAGE.key)
    for basis in BASES:
        start = "" if basis == GT else f"{basis}_"
        for stage, scores in errors.get(basis, {}).items():
            for key in (key for key in shown if key in scores):
                yield f"{start}{key}_{stage}", basis, stage, key


def _cells(record: FrameRecord, measured: Sequence[tuple[str, str, str, str]]) -> Iterator[Any]:
    """The cells of a row; None where a frame has no value."""
    points = record.points
    yield from (record.name, record.status, record.message or "")
    yield from (points and points.used, points and points.held_out, record.improved_fraction)
    for _, basis, stage, key in measured:
        yield record.errors.get(basis, {}).get(stage, {}).get(key)
    yield "; ".join(record.warnings)
    yield from (record.seconds.get(stage) for stage in _RUN_STAGES)
