"""The summary of a batch, `summary.json` and `summary.csv`, from the records of its frames."""

from __future__ import annotations

import itertools
import json
import re
import tempfile
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from pnpdepth_cli.commands.batch.batch_request import BatchRequest
from pnpdepth_cli.commands.batch.find_frames import CSV, JSON, BatchFrames
from pnpdepth_cli.commands.statistics import find_clusters
from pnpdepth_cli.dataset.frame_files import groups_by_name
from pnpdepth_cli.dataset.frame_record import FrameRecord, Scores
from pnpdepth_cli.io.atomic import atomic_path
from pnpdepth_cli.io.text_files import plain, write_csv
from pnpdepth_cli.measures import COVERAGE, MEASURES, FrameMeans
from pnpdepth_cli.stages import AFTER, BASES, GT

# a file name that is no UTF-8 has surrogates; JSON escapes them so
_TEXT: Any = {"encoding": "utf-8", "errors": "backslashreplace", "newline": "\n"}

_MEASURED = (*(measure.key for measure in MEASURES), COVERAGE.key)
_MAIN = tuple(measure.key for measure in MEASURES if measure.main)
_RUN_STAGES = ("read", "refine", "write")
_NUMBER = re.compile(r"\d[\d.,]*")
_NAMED = 3
"""Names of frames that are listed with a warning or note."""


@dataclass(kw_only=True)
class Noted:
    """The frames with one kind of warning or note."""

    note: str
    """The text of the first frame."""
    frames: int = 0
    first: list[str] = field(default_factory=list)
    """Names of the first frames."""

    @property
    def is_warning(self) -> bool:
        """Whether it is a warning."""
        return self.note.startswith("warning")


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
    warnings: list[Noted]
    frame_notes: list[Noted]
    """Notes of frames that begin with "note"."""
    unsure: list[str]
    """What was guessed of the network and may be wrong."""
    unmatched: list[str]
    """Files that are in no frame."""
    varied: dict[str, str]
    """Options that `--vary` varies, with their values."""
    sequence: dict[str, str | int | None]
    """What frames take over from their neighbours."""


class _Totals:
    """What is counted and added up of records, which are not kept."""

    def __init__(self) -> None:
        self.counts = Counter(
            dict.fromkeys(("done", "diverged", "failed", "with_warnings", "compared", "worse"), 0)
        )
        self.units, self.unsure = set[str](), dict[str, None]()
        self.noted = dict[str, Noted]()  # by the text without its numbers
        self.weights = defaultdict[str, list[float]](list)
        self.errors = defaultdict[tuple[str, str], FrameMeans](FrameMeans)  # by basis and stage
        self.with_truth = list[tuple[str, str | None, list[float | None]]]()
        """Name, sequence and main errors of each frame with ground truth."""

    def add(self, record: FrameRecord) -> None:
        """Adds a record."""
        self.counts[record.status] += 1
        if record.status == "failed":
            return
        self.counts["with_warnings"] += bool(record.warnings)
        for note in record.notes:
            if not note.startswith(("warning", "note")):
                continue
            noted = self.noted.setdefault(_NUMBER.sub("", note), Noted(note=note))
            noted.frames += 1
            noted.first += [record.name] if len(noted.first) < _NAMED else []
        self.unsure |= dict.fromkeys(n for n in record.notes if ", unsure (" in n)
        self.units.add(record.unit)
        for basis, stages in record.errors.items():
            for stage, scores in stages.items():
                self.errors[basis, stage].add({k: v for k, v in scores.items() if k in _MEASURED})
        for name, weight in record.weights.items():
            self.weights[name].append(weight)
        if GT in record.errors:
            main = [record.errors[GT][AFTER].get(key) for key in _MAIN]
            self.with_truth.append((record.name, record.group, main))
        if (worse := record.worse_than_linear) is not None:
            self.counts.update(compared=1, worse=int(worse))


def summarise(
    request: BatchRequest,
    found: BatchFrames,
    settings: dict[str, Any],
    records: Iterable[FrameRecord],
) -> BatchSummary:
    """Returns the summary of a batch.

    Args:
        request: The batch.
        found: Its frames.
        settings: What decides the results.
        records: The record of each frame that has one.
    """
    # The records, one by one.
    totals = _Totals()
    for record in records:
        totals.add(record)
    errors: dict[str, dict[str, Scores]] = {}
    for (basis, stage), means in totals.errors.items():
        errors.setdefault(basis, {})[stage] = {"frames": means.frames, **means.means()}
    # What is said of all of them.
    frames = len(found.frames) + len(found.refused)
    ended = sum(totals.counts[kind] for kind in ("done", "diverged", "failed"))
    return BatchSummary(
        source=str(request.source),
        output=str(request.output),
        layout=found.layout,
        fixed_by=request.refine.method.fixed_by,
        settings=settings,
        counts={"frames": frames, **totals.counts, "pending": frames - ended},
        unit=" and ".join(sorted(totals.units)) or "m",
        columns=request.columns,
        notes=_notes(totals.with_truth),
        errors=errors,
        weights={
            name: {"mean": sum(all_) / len(all_), "least": min(all_), "largest": max(all_)}
            for name, all_ in totals.weights.items()
        },
        warnings=[each for each in totals.noted.values() if each.is_warning],
        frame_notes=[each for each in totals.noted.values() if not each.is_warning],
        unsure=list(totals.unsure),
        unmatched=[str(each) for each in found.unmatched],
        varied=dict(request.varied),
        sequence={
            "accumulate": request.accumulate,
            "poses": str(request.poses) if request.poses else None,
        },
    )


def _notes(frames: Sequence[tuple[str, str | None, list[float | None]]]) -> list[str]:
    """How many frames count as independent, given the name, sequence and errors of each."""
    if len(frames) < 2:
        return []
    by_name = groups_by_name([name for name, *_ in frames])
    groups = [own or name for (_, own, _), name in zip(frames, by_name, strict=True)]
    return find_clusters(groups, np.array([errors for *_, errors in frames], np.float64)).notes()


def write_summary(
    request: BatchRequest,
    found: BatchFrames,
    settings: dict[str, Any],
    known: Iterable[FrameRecord],
) -> BatchSummary:
    """Writes `summary.json`, with the records as its list `frames`, `summary.csv` and the report.

    Arguments are those of `summarise`; frames that were refused need no record.
    """
    refused = (
        FrameRecord(name=frame.name, group=frame.group, status="failed", message=why)
        for frame, why in found.refused
    )
    with tempfile.TemporaryFile("w+", dir=request.output, **_TEXT) as file:
        # The records, each a line of a file, as they may be too many for the memory.
        def kept() -> Iterator[FrameRecord]:
            for record in itertools.chain(refused, known):
                line = json.dumps(record.to_json(), ensure_ascii=False, allow_nan=False)
                file.write(f"{line}\n")
                yield record

        def records() -> Iterator[FrameRecord]:
            file.seek(0)
            return (FrameRecord.from_json(json.loads(line), request.output) for line in file)

        # What is made of them.
        summary = summarise(request, found, settings, kept())
        file.seek(0)
        _write_json(request.output / JSON, summary, file)
        _write_csv(request.output / CSV, summary, records())
        if request.html is not None:
            from pnpdepth_cli.commands.report.batch_report import write_batch_report

            write_batch_report(request, request.html, summary, records)
    return summary


def _write_json(path: Path, summary: BatchSummary, lines: Iterable[str]) -> None:
    """Writes the summary, with these lines as its list `frames`."""
    text = json.dumps(plain(asdict(summary)), indent=2, ensure_ascii=False, allow_nan=False)
    with atomic_path(path) as temporary, temporary.open("w", **_TEXT) as file:
        file.write(text.removesuffix("\n}") + ',\n  "frames": [')
        for number, line in enumerate(lines):
            file.write(f"{',' if number else ''}\n    {line.rstrip()}")
        file.write("\n  ]\n}\n")


def _write_csv(path: Path, summary: BatchSummary, records: Iterable[FrameRecord]) -> None:
    """Writes a row for each record, with errors of ground truth first."""
    shown = _MEASURED if summary.columns is None else (*summary.columns, COVERAGE.key)
    measured = [
        (basis, stage, key)
        for basis in BASES
        for stage, scores in summary.errors.get(basis, {}).items()
        for key in shown
        if key in scores
    ]
    header = ["name", "status", "message", "points", "held_out_points", "improved_fraction"]
    header += [f"{'' if b == GT else f'{b}_'}{key}_{stage}" for b, stage, key in measured]
    header += ["warnings", *(f"seconds_{stage}" for stage in _RUN_STAGES)]

    def cells(record: FrameRecord) -> Iterator[Any]:
        points = record.points
        yield from (record.name, record.status, record.message or "")
        yield from (points and points.used, points and points.held_out, record.improved_fraction)
        for basis, stage, key in measured:
            yield record.errors.get(basis, {}).get(stage, {}).get(key)
        yield "; ".join(record.warnings)
        yield from (record.seconds.get(stage) for stage in _RUN_STAGES)

    with atomic_path(path) as temporary, temporary.open("w", **_TEXT) as file:
        write_csv(file, header, (list(cells(record)) for record in records))
