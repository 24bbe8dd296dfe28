"""The records of a batch: by which its frames are done, and of which its summary is made.

`NAME.json` beside a result says how it was made, and of which files. It is written last, by rename,
and removed before the files of `NAME` are written again. Its entry `batch` holds the digest of the
settings and what identifies the inputs.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from pnpdepth_cli import __version__
from pnpdepth_cli.commands.batch.batch_request import BatchRequest
from pnpdepth_cli.commands.batch.find_frames import (
    CSV,
    JSON,
    BatchFrames,
    input_files,
    request_of,
)
from pnpdepth_cli.commands.refinement.refine_request import GROUPS, Outputs, RefineRequest
from pnpdepth_cli.commands.statistics import find_clusters
from pnpdepth_cli.commands.tables import Table, stage_titles, write_text
from pnpdepth_cli.dataset.frame_files import FrameFiles, groups_of
from pnpdepth_cli.dataset.frame_record import BatchState, FrameRecord, Scores
from pnpdepth_cli.errors import InputError, OutputError
from pnpdepth_cli.file_record import FileRecord
from pnpdepth_cli.io.atomic import LOCKS, cannot_write, make_folder, remove_leftovers
from pnpdepth_cli.io.file_bytes import (
    Fingerprint,
    is_unchanged,
    plain,
    read_bytes,
    sha256_of,
    write_json,
)
from pnpdepth_cli.measures import COVERAGE, MEASURES, frame_means
from pnpdepth_cli.models.definition import file_and_part
from pnpdepth_cli.stages import AFTER, BASES, GT

_IMAGES = frozenset({"preview", "improvement"})
"""Kinds of outputs for a person, which may be deleted."""
_NO_SETTINGS = frozenset(
    {
        *("name", "group", "image", "sparse", "sparse_mask", "gt", "masks", "calib", "extrinsics"),
        *("pose", "neighbours", "model", "more_models", "checkpoint", "output", "overwrite"),
        "view_3d",
    }
)
"""Fields that say where something lies, whose content is compared instead, or that add a file."""
_MEASURED = (*(measure.key for measure in MEASURES), COVERAGE.key)
_MAIN = tuple(measure.key for measure in MEASURES if measure.main)
_RUN_STAGES = ("read", "refine", "write")
_NUMBER = re.compile(r"\d[\d.,]*")
_OWN_SUMMARY = b'{\n  "command": "batch"'


class Records:
    """The records of frames that are refined alike, in the output folder of a batch.

    Args:
        request: The batch; its network and code are taken as they are now.
    """

    def __init__(self, request: BatchRequest) -> None:
        self.request = request
        self.settings = _settings_of(request.refine) | _code_of(request.refine)
        """What decides the results."""

    def outputs_of(self, frame: FrameFiles) -> Outputs:
        """Returns the files of a frame's result."""
        output, refine = self.request.output, self.request.refine
        return refine.outputs_in(output, frame.name, with_gt=frame.gt is not None)

    def check_new(self, frames: Iterable[FrameFiles]) -> None:
        """Raises OutputError if no batch has written to the folder, and a result exists there."""
        output = self.request.output
        with suppress(InputError):
            if read_bytes(output / JSON).startswith(_OWN_SUMMARY):
                return
        if any(output.glob(LOCKS)):
            return
        results = (path for frame in frames for path in self.outputs_of(frame).values())
        for path in (output / CSV, output / JSON, *results):
            if path.exists():
                raise OutputError(
                    f"{path} exists, and no batch wrote it; --overwrite replaces such files, -o"
                    " names another folder"
                )

    def reason_to_refine(self, frame: FrameFiles) -> str | None:
        """Returns why a frame is to be refined; None if it is done with its settings and files."""
        # The record.
        request, outputs = request_of(self.request, frame), self.outputs_of(frame)
        if not outputs["record"].exists():
            return "interrupted" if any(path.exists() for path in outputs.values()) else "new"
        record = _read(outputs["record"])
        if record is None:
            return "record damaged"
        if record.status == "failed" and record.batch is not None:
            return "failed before"
        if record.batch is None or record.batch.settings != self._digest(request):
            return "other settings"
        # The files that were read, and those that were written.
        inputs, known = dict(input_files(request)), record.batch.inputs
        if known.keys() != inputs.keys():
            return "other input files"
        if not all(is_unchanged(path, known[part]) for part, path in inputs.items()):
            return "input changed"
        there = all(path.exists() for kind, path in outputs.items() if kind not in _IMAGES)
        return None if there else "result missing"

    def record_of(self, frame: FrameFiles) -> FrameRecord | None:
        """Returns the record of a frame with its present settings; None if there is none."""
        record = _read(self.outputs_of(frame)["record"])
        if record is None or record.batch is None:
            return None
        present = self._digest(request_of(self.request, frame))
        return record if record.batch.settings == present else None

    def state(self, request: RefineRequest, inputs: Mapping[str, Fingerprint]) -> BatchState:
        """Returns by what a frame is known to be done: its settings, and the files by part."""
        return BatchState(settings=self._digest(request), inputs=dict(inputs))

    def fail(self, request: RefineRequest, message: str) -> FrameRecord:
        """Writes a record that says why a frame failed, and returns it."""
        files = request.files
        record = FrameRecord(
            name=files.name,
            group=files.group,
            status="failed",
            message=message,
            batch=self.state(request, {}),
            inputs={part: FileRecord(path=str(path)) for part, path in input_files(request)},
        )
        path = self.outputs_of(files)["record"]
        make_folder(path.parent, below=self.request.output)
        record.write(path)
        return record

    def _digest(self, request: RefineRequest) -> str:
        """The SHA-256 of the settings that decide the frame's result."""
        own = self.settings | _settings_of(request)
        if request.files.pose is not None:  # to a micrometre, as processors round differently
            own["pose"] = [[round(value, 6) + 0.0 for value in row] for row in request.files.pose]
        text = json.dumps(own, sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()


def _settings_of(request: RefineRequest) -> dict[str, object]:
    """The settings that decide a frame's result, in JSON's own types."""
    groups = [vars(getattr(request, name)) for name in GROUPS]
    own = {name: value for name, value in vars(request).items() if name not in GROUPS}
    values = {
        name: value
        for group in (*groups, own)
        for name, value in group.items()
        if name not in _NO_SETTINGS
    }
    if neighbours := request.files.neighbours:
        values["neighbours"] = [(other.motion, other.apart) for other in neighbours]
    # Devices of one kind give equal results, so shards may use one each.
    values["device"] = request.network.device.split(":")[0]
    scan = asdict(request.reading.scan).items()
    values["scan"] = {name: value for name, value in scan if name not in _NO_SETTINGS}
    return dict(plain(values))


def _code_of(request: RefineRequest) -> dict[str, object]:
    """The program's version, and names and digests of the networks' and the user's own files."""
    network, method = request.network, vars(request.method).values()
    code = [value for value in method if isinstance(value, str) and value.endswith(".py")]
    files = [_identity(spec) for spec in (network.model, *network.more_models, *code)]
    return {
        "version": __version__,
        "model": files[0][0],
        "files": files,
        "checkpoint": network.checkpoint and _identity(str(network.checkpoint)),
    }


def _identity(spec: str) -> tuple[str, str | None]:
    """A file's name with its :PART but without its folder, and its digest; or another name."""
    path, part = file_and_part(Path(spec))
    if not path.exists():
        return spec, None
    return f"{path.name}:{part}".rstrip(":"), sha256_of(path)


def remove_all_leftovers(output: Path) -> int:
    """Removes the half-written files of a killed run below the folder; returns how many."""
    try:
        return sum(remove_leftovers(Path(folder)) for folder, _, _ in os.walk(output))
    except OSError as error:
        raise cannot_write(output, error) from error


def _read(path: Path) -> FrameRecord | None:
    """The record in a file; None if there is none, or it is damaged."""
    try:
        return FrameRecord.read(path)
    except InputError:
        return None


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
    titles: dict[str, str]
    """What each stage is, in words."""
    weights: dict[str, dict[str, float]]
    """Mean, least and largest weight of each expert of the default method, by name."""
    frame_notes: dict[str, list[str]]
    """Warnings, notes and unsure guesses, each once, with the names of the frames that have it."""
    unmatched: list[str]
    """Files that are in no frame."""
    varied: dict[str, str]
    """Options that `--vary` varies, with their values."""


def write_summary(
    request: BatchRequest,
    found: BatchFrames,
    settings: Mapping[str, object],
    records: Sequence[FrameRecord],
) -> BatchSummary:
    """Writes `summary.json`, with the records as its `frames`, `summary.csv` and the report."""
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
    # Weights of the networks.
    weights = defaultdict[str, list[float]](list)
    for record in results:
        for name, weight in record.weights.items():
            weights[name].append(weight)
    means = {name: sum(of_frames) / len(of_frames) for name, of_frames in weights.items()}
    summary = BatchSummary(
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
        titles=stage_titles(replace(results[0], weights=means)) if results else {},
        weights={
            name: {"mean": means[name], "least": min(all_), "largest": max(all_)}
            for name, all_ in weights.items()
        },
        frame_notes=_frame_notes(results),
        unmatched=[str(each) for each in found.unmatched],
        varied=dict(request.varied),
    )
    # The files.
    frames = [record.to_json() for record in records]
    write_json(request.output / JSON, {**asdict(summary), "frames": frames})
    write_text(request.output / CSV, _table(summary, records).csv())
    if request.html is not None:
        from pnpdepth_cli.commands.batch.batch_report import write_batch_report

        write_batch_report(request, request.html, summary, records)
    return summary


def _frame_notes(records: Iterable[FrameRecord]) -> dict[str, list[str]]:
    """The names of the frames by their notes, warnings first.

    Of notes that differ in numbers alone, the first stands for all, with its frame's name.
    """
    kinds = defaultdict[str, dict[str, str]](dict)
    for record in records:
        for note in record.notes:
            if note.startswith(("warning", "note")) or ", unsure (" in note:
                kinds[_NUMBER.sub("", note)].setdefault(record.name, note)
    noted: dict[str, list[str]] = {}
    for of in kinds.values():
        first, note = next(iter(of.items()))
        if len({*of.values()}) > 1:
            note += f" (numbers of {first})"
        noted[note] = list(of)
    return dict(sorted(noted.items(), key=lambda item: not item[0].startswith("warning")))


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
    groups = groups_of([each.name for each in records], [each.group for each in records])
    errors = [[each.errors[GT][AFTER].get(key) for key in _MAIN] for each in records]
    return find_clusters(groups, np.array(errors, np.float64)).notes()


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
