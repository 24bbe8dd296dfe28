"""The records of a batch: by which its frames are done, and of which its summary is made.

`NAME.json` beside a result says how it was made, and of which files. It is written last, by rename,
and removed before the files of `NAME` are written again. Its entry `batch` holds the digest of the
settings and what identifies the inputs.
"""

from __future__ import annotations

import hashlib
import json
import re
import traceback
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from pnpdepth_cli.commands.many_frames.find_frames import (
    CSV,
    JSON,
    BatchFrames,
    input_files,
    request_of,
)
from pnpdepth_cli.commands.requests.batch_request import BatchRequest
from pnpdepth_cli.commands.requests.refine_request import GROUPS, Outputs, RefineRequest
from pnpdepth_cli.commands.shared.statistics import find_clusters
from pnpdepth_cli.commands.shared.tables import Table, stage_titles, write_text
from pnpdepth_cli.dataset.frame_files import FrameFiles, groups_of
from pnpdepth_cli.dataset.frame_record import BatchState, FrameRecord, Scores
from pnpdepth_cli.errors import InputError, OutputError, PnpDepthError
from pnpdepth_cli.file_record import FileRecord
from pnpdepth_cli.io.atomic import LOCKS, make_folder
from pnpdepth_cli.io.file_bytes import fingerprint, is_unchanged, plain, read_bytes, write_json
from pnpdepth_cli.measures import AFTER, BASES, COVERAGE, GT, MEASURES, frame_means
from pnpdepth_cli.models.definition import file_and_part
from pnpdepth_cli.version import __version__

_IMAGES = ("preview", "improvement")
"""Kinds of outputs for a person, which may be deleted."""
_NO_SETTINGS = (
    *("name", "group", "image", "sparse", "sparse_mask", "gt", "masks", "calib", "extrinsics"),
    *("pose", "neighbours", "model", "more_models", "checkpoint", "output", "overwrite"),
    *("view_3d", "is_first"),
)
"""Fields that say where something lies, whose content is compared instead, or that add a file or a
line."""
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
        return refine.outputs_in(output, frame.name)

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
                hint = "--overwrite replaces such files, -o names another folder"
                raise OutputError(f"{path} exists, and no batch wrote it; {hint}")

    def find(self, frame: FrameFiles) -> FrameRecord | str:
        """Returns the record of a frame with its present settings, or why there is none."""
        outputs = self.outputs_of(frame)
        if not outputs["record"].exists():
            return "interrupted" if any(path.exists() for path in outputs.values()) else "new"
        try:
            record = FrameRecord.read(outputs["record"])
        except InputError:
            return "record damaged"
        present = self._digest(request_of(self.request, frame))
        return record if record.batch and record.batch.settings == present else "other settings"

    def reason_to_refine(self, frame: FrameFiles) -> str | None:
        """Returns why a frame is to be refined; None if it is done with its settings and files."""
        record = self.find(frame)
        if isinstance(record, str):
            return record
        if record.batch is None or record.status == "failed":
            return "failed before"
        # The files that were read, and those that were written.
        inputs, known = dict(input_files(request_of(self.request, frame))), record.batch.inputs
        if known.keys() != inputs.keys():
            return "other input files"
        if not all(is_unchanged(path, known[part]) for part, path in inputs.items()):
            return "input changed"
        written = [path for kind, path in self.outputs_of(frame).items() if kind not in _IMAGES]
        return None if all(path.exists() for path in written) else "result missing"

    def state(self, request: RefineRequest) -> BatchState:
        """Returns by what a frame is known to be done: its settings, and the files as they are."""
        inputs = {part: fingerprint(path) for part, path in input_files(request)}
        return BatchState(settings=self._digest(request), inputs=inputs)

    def fail(self, request: RefineRequest, error: Exception | None) -> FrameRecord:
        """Writes a record that says why a frame failed, and returns it."""
        files, message = request.files, str(error)
        if error is not None and not isinstance(error, PnpDepthError):
            line = traceback.extract_tb(error.__traceback__)[-1]
            where = f"{Path(line.filename).name}, line {line.lineno}"
            message = f"a bug of pnpdepth: {type(error).__name__}: {error} ({where})"
        record = FrameRecord(
            name=files.name,
            group=files.group,
            status="failed",
            message=message,
            batch=BatchState(settings=self._digest(request)),
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
    """The settings, but no files, that decide a frame's result, in JSON's own types."""
    values = dict[str, object]()
    for name, value in vars(request).items():
        values |= vars(value) if name in GROUPS else {name: value}
    values = {name: value for name, value in values.items() if name not in _NO_SETTINGS}
    if neighbours := request.files.neighbours:
        values["neighbours"] = [(other.motion, other.apart) for other in neighbours]
    # Devices of one kind give equal results, so shards may use one each.
    values["device"] = request.device.split(":")[0]
    scan = asdict(request.reading.scan).items()
    values["scan"] = {name: value for name, value in scan if name not in _NO_SETTINGS}
    return dict(plain(values))


def _code_of(request: RefineRequest) -> dict[str, object]:
    """The program's version, and names and digests of the networks' and the user's own files."""
    method = vars(request.method).values()
    code = [value for value in method if isinstance(value, str) and value.endswith(".py")]
    files = [_identity(spec) for spec in (request.model, *request.more_models, *code)]
    return {
        "version": __version__,
        "model": files[0][0],
        "files": files,
        "checkpoint": request.checkpoint and _identity(str(request.checkpoint)),
    }


def _identity(spec: str) -> tuple[str, str | None]:
    """A file's name with its :PART but without its folder, and its digest; or another name."""
    path, part = file_and_part(Path(spec))
    if not path.exists():
        return spec, None
    return f"{path.name}:{part}".rstrip(":"), fingerprint(path).sha256


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
    chosen = {frame.name for frame in found.chosen}
    worse = [w for record in results if (w := record.worse_than_linear) is not None]
    counts = {
        "frames": len(found.frames),
        **{status: statuses[status] for status in ("done", "diverged", "failed")},
        "with_warnings": sum(bool(record.warnings) for record in results),
        "compared": len(worse),
        "worse": sum(worse),
        "pending": len(found.frames) - len(records),
        "chosen": len(chosen),
        "chosen_not_done": sum(r.status != "done" for r in records if r.name in chosen),
    }
    # Weights of the networks; one that a frame lacks has none there.
    weights, fused = {}, [record.weights for record in results if record.weights]
    for name in dict.fromkeys(name for of_frame in fused for name in of_frame):
        own = [of_frame.get(name, 0.0) for of_frame in fused]
        weights[name] = {"mean": sum(own) / len(own), "least": min(own), "largest": max(own)}
    means = {name: weight["mean"] for name, weight in weights.items()}
    longest = max(results, key=lambda record: len(record.loss), default=None)  # none diverged early
    summary = BatchSummary(
        source=str(request.source),
        output=str(request.output),
        layout=found.layout,
        method=request.refine.method.method,
        settings=settings,
        counts=counts,
        unit=" and ".join(sorted({record.unit for record in results})) or "m",
        columns=request.columns,
        notes=_notes([record for record in results if GT in record.errors]),
        errors=_means(results),
        titles=stage_titles(replace(longest, weights=means)) if longest else {},
        weights=weights,
        frame_notes=_frame_notes(results),
        unmatched=[*found.unmatched],
        varied=dict(request.varied),
    )
    # The files.
    frames = [record.to_json() for record in records]
    write_json(request.output / JSON, {**asdict(summary), "frames": frames})
    write_text(request.output / CSV, _table(summary, records).csv())
    if request.html is not None:
        from pnpdepth_cli.commands.many_frames.batch_report import write_batch_report

        write_batch_report(request, request.html, summary, records)
    return summary


def _frame_notes(records: Iterable[FrameRecord]) -> dict[str, list[str]]:
    """Frames by their notes, warnings first; of notes that differ in numbers, the first stays."""
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
