"""The summary of a batch: what its records have in common, as summary.json and summary.csv."""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np

from pnpdepth_cli.commands.many_frames.find_frames import CSV, JSON, BatchFrames
from pnpdepth_cli.commands.requests.batch_request import BatchRequest
from pnpdepth_cli.commands.shared.statistics import find_clusters
from pnpdepth_cli.commands.shared.tables import Table, stage_titles, write_text
from pnpdepth_cli.dataset.frame_files import groups_of
from pnpdepth_cli.dataset.frame_record import FrameRecord, ResultRecord, Scores
from pnpdepth_cli.io.file_bytes import write_json
from pnpdepth_cli.measures import AFTER, BASES, COVERAGE, GT, MEASURES, frame_means
from pnpdepth_cli.points import METRES

_MEASURED = (*(measure.key for measure in MEASURES), COVERAGE.key)
"""Keys of what is averaged over frames; others, such as numbers of pixels, are not."""
_MAIN = tuple(measure.key for measure in MEASURES if measure.main)
"""Keys of the measures whose correlation tells whether frames are independent."""
_RUN_STAGES = ("read", "refine", "write")
"""What the seconds of each frame are listed for."""
_NUMBER = re.compile(r"\d[\d.,]*")
"""A number in a note."""


@dataclass(frozen=True, kw_only=True)
class BatchSummary:
    """What `summary.json` says of all frames together."""

    command: str = "batch"
    source: str
    output: str
    layout: str
    method: str
    """The method of all frames."""
    settings: Mapping[str, object]
    """What decides the results."""
    counts: dict[str, int]
    """Frames: all, done, diverged, failed, pending, with warnings, and worse than linear
    interpolation of those that are compared with it; those that the last run chose."""
    unit: str
    columns: Sequence[str] | None
    """Measures of the tables. None: all."""
    notes: list[str]
    errors: dict[str, dict[str, Scores]]
    """Means over the frames that have the value, by basis and stage, with their number."""
    titles: dict[str, str]
    """What each stage is, in words."""
    weights: dict[str, dict[str, float]]
    """Mean, least and largest weight of each depth that the default method fuses, by name."""
    frame_notes: dict[str, list[str]]
    """Warnings, notes and unsure guesses, each once, with the names of the frames that have it."""
    unmatched: list[str]
    """Files that are in no frame."""
    varied: dict[str, str]
    """Options that `--vary` varies, with their values."""


def write_summary(
    request: BatchRequest,
    batch: BatchFrames,
    settings: Mapping[str, object],
    records: Sequence[FrameRecord],
) -> BatchSummary:
    """Writes `summary.json`, with the records as its `frames`, and `summary.csv`.

    Args:
        request: What is asked of the batch.
        batch: Its frames.
        settings: What decides the results.
        records: The records of the frames that are done, diverged or failed.

    Returns:
        What both files are made of.
    """
    # Frames that failed are counted, and have no part in means.
    refined = [record for record in records if record.status != "failed"]
    results = [record.result for record in refined if record.result is not None]
    weights = _weights_of(results)
    summary = BatchSummary(
        source=str(request.source),
        output=str(request.output),
        layout=batch.layout,
        method=request.refine.method.method,
        settings=settings,
        counts=_counts(batch, records),
        unit=" and ".join(sorted({record.unit for record in refined})) or METRES,
        columns=request.columns,
        notes=_notes_on_clusters([record for record in refined if GT in record.errors]),
        errors=_means(refined),
        titles=_titles(results, weights),
        weights=weights,
        frame_notes=_frame_notes(refined),
        unmatched=[*batch.unmatched],
        varied=dict(request.varied),
    )
    # The files, with all records.
    frames = [record.to_json() for record in records]
    write_json(request.output / JSON, {**asdict(summary), "frames": frames})
    write_text(request.output / CSV, _table(summary, records).csv())
    return summary


def _counts(batch: BatchFrames, records: Sequence[FrameRecord]) -> dict[str, int]:
    """Numbers of frames, as `BatchSummary.counts` has them.

    Args:
        batch: The frames of the batch.
        records: The records of those that are done, diverged or failed.
    """
    statuses = Counter[str](record.status for record in records)
    refined = [record for record in records if record.status != "failed"]
    worse = [record.worse_than_linear for record in refined]  # None: it is not compared
    chosen = {frame.name for frame in batch.chosen}
    not_done = [record for record in records if record.status != "done" and record.name in chosen]
    return {
        "frames": len(batch.frames),
        "done": statuses["done"],
        "diverged": statuses["diverged"],
        "failed": statuses["failed"],
        "with_warnings": sum(bool(record.warnings) for record in refined),
        "compared": len(worse) - worse.count(None),
        "worse": worse.count(True),
        "pending": len(batch.frames) - len(records),
        "chosen": len(chosen),
        "chosen_not_done": len(not_done),
    }


def _weights_of(results: Sequence[ResultRecord]) -> dict[str, dict[str, float]]:
    """Mean, least and largest weight over the frames of each depth that is fused, by its name.

    These are the depth of each network, and linear interpolation. One that a frame lacks has weight
    0 there; frames without weights, as of other methods, are left out.
    """
    of_frames = [result.weights for result in results if result.weights]
    weights = dict[str, dict[str, float]]()
    for name in dict.fromkeys(name for of_frame in of_frames for name in of_frame):
        values = [of_frame.get(name, 0.0) for of_frame in of_frames]
        weights[name] = {
            "mean": sum(values) / len(values),
            "least": min(values),
            "largest": max(values),
        }
    return weights


def _titles(
    results: Sequence[ResultRecord], weights: Mapping[str, Mapping[str, float]]
) -> dict[str, str]:
    """What each stage of the refinement is, in words, by stage; empty without any result.

    Args:
        results: The results of the batch, which are all made alike.
        weights: Weights of what is fused to the results, as `_weights_of` returns them. The titles
            show the means.
    """
    if not results:
        return {}
    longest = max(results, key=lambda result: len(result.loss))  # it did not diverge early
    means = {name: weight["mean"] for name, weight in weights.items()}
    return stage_titles(replace(longest, weights=means))


def _frame_notes(records: Iterable[FrameRecord]) -> dict[str, list[str]]:
    """The names of the frames that have a note, by the note; warnings come first.

    Notes that differ in numbers only are one, with the numbers of its first frame, which it names.
    """
    # The note of each frame, by what it says without its numbers, then by the frame's name.
    by_text = defaultdict[str, dict[str, str]](dict)
    for record in records:
        for note in record.notes:
            # A guess that is unsure says so in the middle of its line.
            if note.startswith(("warning", "note")) or ", unsure (" in note:
                text = _NUMBER.sub("", note)
                by_text[text].setdefault(record.name, note)
    frames_of_notes: dict[str, list[str]] = {}
    for note_of_frame in by_text.values():
        names = [*note_of_frame]
        note = note_of_frame[names[0]]
        if len({*note_of_frame.values()}) > 1:
            note += f" (numbers of {names[0]})"
        frames_of_notes[note] = names

    def is_no_warning(entry: tuple[str, list[str]]) -> bool:
        """Whether the note of an entry (note, names of frames) is none that begins with warning."""
        return not entry[0].startswith("warning")

    return dict(sorted(frames_of_notes.items(), key=is_no_warning))  # False comes first


def _means(records: Iterable[FrameRecord]) -> dict[str, dict[str, Scores]]:
    """The mean errors over frames, by basis and stage, with "frames", the number of frames."""
    of_stages = defaultdict[tuple[str, str], list[Scores]](list)
    for record in records:
        for basis, stages in record.errors.items():
            for stage, scores in stages.items():
                measured = {key: value for key, value in scores.items() if key in _MEASURED}
                of_stages[basis, stage].append(measured)
    means: dict[str, dict[str, Scores]] = {}
    for (basis, stage), frames in of_stages.items():
        # A frame without any value, as where nothing is known, does not count.
        count = sum(any(value is not None for value in scores.values()) for scores in frames)
        means.setdefault(basis, {})[stage] = {"frames": count, **frame_means(frames)}
    return means


def _notes_on_clusters(records: Sequence[FrameRecord]) -> list[str]:
    """A line on how many frames count as independent, if not all of them do.

    Args:
        records: The records of the frames with ground truth.
    """
    if len(records) < 2:
        return []
    names = [record.name for record in records]
    groups = groups_of(names, [record.group for record in records])
    errors = [[record.errors[GT][AFTER].get(key) for key in _MAIN] for record in records]
    return find_clusters(groups, np.array(errors, np.float64)).notes()  # None becomes NaN


def _table(summary: BatchSummary, records: Iterable[FrameRecord]) -> Table:
    """A row for each record, with errors of ground truth first.

    Args:
        summary: The summary, whose errors say which columns of errors there are.
        records: The records of the frames that are done, diverged or failed.
    """
    # The columns of errors are those that any frame has.
    shown = _MEASURED if summary.columns is None else (*summary.columns, COVERAGE.key)
    measured = list[tuple[str, str, str]]()
    for basis in BASES:
        for stage, scores in summary.errors.get(basis, {}).items():
            measured += [(basis, stage, key) for key in shown if key in scores]
    columns = ["name", "status", "message", "points", "held_out_points", "improved_fraction"]
    for basis, stage, key in measured:
        name = f"{key}_{stage}"
        columns.append(name if basis == GT else f"{basis}_{name}")
    columns.append("warnings")
    columns += [f"seconds_{stage}" for stage in _RUN_STAGES]
    # A frame that failed has no result, and its cells are empty.
    rows = []
    for record in records:
        result = record.result
        row: list[object] = [record.name, record.status, record.message or ""]
        if result is None:
            row += [None, None, None]
        else:
            row += [result.points.used, result.points.held_out, result.improved_fraction]
        for basis, stage, key in measured:
            row.append(record.errors.get(basis, {}).get(stage, {}).get(key))
        row.append("; ".join(record.warnings))
        row += [None if result is None else result.seconds.get(stage) for stage in _RUN_STAGES]
        rows.append(row)
    return Table(columns=columns, rows=rows)
