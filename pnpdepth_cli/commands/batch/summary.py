"""The summary of a batch, `summary.json` and `summary.csv`, from the records of its frames."""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field

import numpy as np

from pnpdepth_cli.commands.batch.batch_request import BatchRequest
from pnpdepth_cli.commands.batch.find_frames import CSV, JSON, BatchFrames
from pnpdepth_cli.commands.statistics import find_clusters
from pnpdepth_cli.commands.tables import Table, write_text
from pnpdepth_cli.dataset.frame_files import groups_by_name
from pnpdepth_cli.dataset.frame_record import FrameRecord, Scores
from pnpdepth_cli.io.file_bytes import write_json
from pnpdepth_cli.measures import COVERAGE, MEASURES, frame_means
from pnpdepth_cli.stages import AFTER, BASES, GT

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
    settings: Mapping[str, object]
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
    """Notes that begin with "note", and unsure guesses."""
    unmatched: list[str]
    """Files that are in no frame."""
    varied: dict[str, str]
    """Options that `--vary` varies, with their values."""


def summarise(
    request: BatchRequest,
    found: BatchFrames,
    settings: Mapping[str, object],
    records: Sequence[FrameRecord],
) -> BatchSummary:
    """Returns the summary of a batch, from the record of each frame that has one."""
    # Counts of frames.
    results = [record for record in records if record.status != "failed"]
    statuses = Counter[str](record.status for record in records)
    worse = [w for record in results if (w := record.worse_than_linear) is not None]
    counts = {
        "frames": len(found.frames),
        **{status: statuses[status] for status in ("done", "diverged", "failed")},
        "with_warnings": sum(bool(record.warnings) for record in results),
        "compared": len(worse),
        "worse": sum(worse),
        "pending": len(found.frames) - len(records),
    }
    # Weights of the networks, and what is noted of frames.
    weights = defaultdict[str, list[float]](list)
    for record in results:
        for name, weight in record.weights.items():
            weights[name].append(weight)
    noted = _noted(results)
    return BatchSummary(
        source=str(request.source),
        output=str(request.output),
        layout=found.layout,
        fixed_by=request.refine.method.fixed_by,
        settings=settings,
        counts=counts,
        unit=" and ".join(sorted({record.unit for record in results})) or "m",
        columns=request.columns,
        notes=_notes([record for record in results if GT in record.errors]),
        errors=_means(results),
        weights={
            name: {"mean": sum(all_) / len(all_), "least": min(all_), "largest": max(all_)}
            for name, all_ in weights.items()
        },
        warnings=[each for each in noted if each.is_warning],
        frame_notes=[each for each in noted if not each.is_warning],
        unmatched=[str(each) for each in found.unmatched],
        varied=dict(request.varied),
    )


def _noted(records: Iterable[FrameRecord]) -> list[Noted]:
    """Warnings and notes of frames; those that differ in numbers only are one."""
    kinds = dict[str, Noted]()
    for record in records:
        for note in record.notes:
            if note.startswith(("warning", "note")) or ", unsure (" in note:
                noted = kinds.setdefault(_NUMBER.sub("", note), Noted(note=note))
                noted.frames += 1
                noted.first += [record.name] if len(noted.first) < _NAMED else []
    return list(kinds.values())


def _means(records: Iterable[FrameRecord]) -> dict[str, dict[str, Scores]]:
    """The mean errors over frames, by basis and stage, with their number."""
    of_stages = defaultdict[tuple[str, str], list[Scores]](list)
    for record in records:
        for basis, stages in record.errors.items():
            for stage, scores in stages.items():
                own = {key: value for key, value in scores.items() if key in _MEASURED}
                of_stages[basis, stage].append(own)
    means: dict[str, dict[str, Scores]] = {}
    for (basis, stage), frames in of_stages.items():
        count = sum(any(value is not None for value in own.values()) for own in frames)
        means.setdefault(basis, {})[stage] = {"frames": count, **frame_means(frames)}
    return means


def _notes(records: Sequence[FrameRecord]) -> list[str]:
    """How many frames with ground truth count as independent."""
    if len(records) < 2:
        return []
    by_name = groups_by_name([record.name for record in records])
    groups = [each.group or name or each.name for each, name in zip(records, by_name, strict=True)]
    errors = [[each.errors[GT][AFTER].get(key) for key in _MAIN] for each in records]
    return find_clusters(groups, np.array(errors, np.float64)).notes()


def write_summary(
    request: BatchRequest,
    found: BatchFrames,
    settings: Mapping[str, object],
    records: Sequence[FrameRecord],
) -> BatchSummary:
    """Writes `summary.json`, with the records as its `frames`, `summary.csv` and the report."""
    summary = summarise(request, found, settings, records)
    frames = [record.to_json() for record in records]
    write_json(request.output / JSON, {**asdict(summary), "frames": frames})
    write_text(request.output / CSV, _table(summary, records).csv())
    if request.html is not None:
        from pnpdepth_cli.commands.batch.batch_report import write_batch_report

        write_batch_report(request, request.html, summary, records)
    return summary


def _table(summary: BatchSummary, records: Iterable[FrameRecord]) -> Table:
    """A row for each record, with errors of ground truth first."""
    shown = _MEASURED if summary.columns is None else (*summary.columns, COVERAGE.key)
    measured = [
        (basis, stage, key)
        for basis in BASES
        for stage, scores in summary.errors.get(basis, {}).items()
        for key in shown
        if key in scores
    ]
    columns = ["name", "status", "message", "points", "held_out_points", "improved_fraction"]
    columns += [f"{'' if b == GT else f'{b}_'}{key}_{stage}" for b, stage, key in measured]
    columns += ["warnings", *(f"seconds_{stage}" for stage in _RUN_STAGES)]
    rows = []
    for record in records:
        points, errors = record.points, record.errors
        row: list[object] = [record.name, record.status, record.message or ""]
        row += [points and points.used, points and points.held_out, record.improved_fraction]
        row += [errors.get(basis, {}).get(stage, {}).get(key) for basis, stage, key in measured]
        row += ["; ".join(record.warnings), *(record.seconds.get(stage) for stage in _RUN_STAGES)]
        rows.append(row)
    return Table(columns=columns, rows=rows)
