"""`pnpdepth batch --html`: each frame before and after refinement.

Everything is read from the results on disk: scores from the rows of the summary, images from the
previews and, with ground truth, the improvement maps, which the report links as they were written.
The records say where their panels are. So a report also has the frames of earlier runs.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from pnpdepth_cli.commands.many_frames.summary import BatchSummary
from pnpdepth_cli.commands.requests.batch_request import BatchRequest
from pnpdepth_cli.commands.shared.tables import (
    bases_of,
    mean_weights_text,
    means_tables,
    weights_text,
)
from pnpdepth_cli.dataset.frame_record import FrameRecord, ResultRecord, Scores
from pnpdepth_cli.errors import OutputError
from pnpdepth_cli.io import report
from pnpdepth_cli.measures import (
    AFTER,
    BASES,
    BEFORE,
    GT,
    MEASURES,
    USED,
    VALIDATION,
    Measure,
    choose_measures,
)

_LABELS = {
    "first": "Depth before",
    "second": "Depth after",
    "map": "Change of error",
    "image": "Image",
    "sparse": "Sparse depth",
    "gt": "Ground truth",
}
"""Titles of the panels of a figure, by the view of the page."""
_CHANGE = "change"
"""End of the keys of changes, which are fractions of the error before."""
_KEY_LENGTH = 20
"""Hexadecimal digits of a frame's key: 80 bits, so that no two frames have one."""
_SETTINGS = (
    "model",
    "layer",
    "iterations",
    "lr",
    "loss",
    "update",
    "align",
    "propagate",
    "holdout",
    "seed",
)
"""The settings that the page lists, in this order."""


def check_batch_report(request: BatchRequest, folder: Path) -> None:
    """Raises OutputError for a folder that the report cannot or may not be written to.

    Args:
        request: Request of the batch, whose results must not lie in the folder.
        folder: Folder of the report.
    """
    if Path(os.path.realpath(request.output)).is_relative_to(os.path.realpath(folder)):
        raise OutputError(
            f"{folder} holds the results; name another folder, such as {request.output / 'report'}"
        )
    source = _source(request, folder)
    report.check_report_folder(folder, source, overwrite=request.refine.overwrite)


def write_batch_report(
    request: BatchRequest, folder: Path, summary: BatchSummary, records: Sequence[FrameRecord]
) -> None:
    """Writes the page, and links the images of all frames.

    Args:
        request: Request of the batch.
        folder: Folder of the report.
        summary: The batch's summary.
        records: The records of the frames.
    """
    # What is measured, and on which pixels or points.
    results = [(frame, frame.result) for frame in records if frame.result is not None]
    basis = next(iter(bases_of(summary.errors)), USED)
    columns = _columns(basis, summary.unit)
    notes = [*summary.notes]
    if summary.unmatched:
        notes.append(
            f"warning: {len(summary.unmatched):,} files are in no frame; summary.json has them"
        )
    if results and basis == USED:
        notes.append("Without ground truth or --holdout, no error is measured.")
    # What the page shows of all frames.
    settings_of_first = next((result.settings for _, result in results), {})
    page = {
        "title": summary.output,
        "facts": _facts(summary, settings_of_first),
        "notes": notes,
        "tables": means_tables(summary.errors, summary.unit, summary.titles, summary.columns),
        "without": [(frame.name, frame.message or "") for frame in records if frame.result is None],
    }
    # What its script sorts and draws by: the first column is a change, unless there are none.
    keys = [measure.key for measure in columns]
    script_data = {
        "columns": [measure.to_json() for measure in columns],
        "sort_by": keys.index(f"rmse_{AFTER}") if basis == USED else 0,
        "signed": [key for key in keys if key.endswith(_CHANGE)],
        "unit": summary.unit,
    }

    # A frame a time, so that memory does not grow with their number.
    def entries(images: Path) -> Iterator[dict[str, object]]:
        """Yields the page's entry of each frame, whose images are linked in the folder."""
        for frame, result in results:
            views = _views(frame.name, result, request, images)
            yield _entry(frame, basis, columns) | views

    source = _source(request, folder)
    report.write_report(folder, source, page, script_data, entries, viewer=request.html_3d)


def _source(request: BatchRequest, folder: Path) -> dict[str, object]:
    """The batch that the report is of, by which a later run knows the report as its own.

    It is the path of the batch's output, seen from the report's folder.
    """
    output = os.path.relpath(os.path.realpath(request.output), os.path.realpath(folder))
    return {"command": "batch", "output": output}


def _entry(record: FrameRecord, basis: str, columns: Sequence[Measure]) -> dict[str, object]:
    """The page's entry of a frame: its values in these columns, its notes and its tag.

    Args:
        record: Record of a frame with a result.
        basis: What the errors of all frames are shown on, a key of `measures.BASES`. A frame
            without such errors has no values; a tag and a note say what it has instead.
        columns: Columns of the table, of `_columns`.
    """
    values = dict[str, float | None]()
    tag = ""
    basis_of_frame = basis
    if basis in record.errors:
        values = _values(record.errors[basis])
    else:
        basis_of_frame = next(iter(bases_of(record.errors)), "")
        tag = BASES.get(basis_of_frame, "")
    return {
        "name": record.name,
        "values": [values.get(measure.key) for measure in columns],
        "notes": _notes(record, basis_of_frame),
        "tag": "diverged" if record.status == "diverged" else tag,
    }


def _views(
    name: str, result: ResultRecord, request: BatchRequest, images: Path
) -> dict[str, object]:
    """Links the images of a frame into the report; returns the page's entry of them.

    Args:
        name: Name of the frame.
        result: The frame's result, which names its images.
        request: The batch, below whose output they lie.
        images: Folder for images of the report.

    Returns:
        key: beginning of the names of the frame's files in the report. None if the frame has no
        preview or an image was deleted; then nothing is linked, and the entry has nothing else.
        views: for each view of the page, its PNG, the box (left, top, width, height) of its panel,
        and the size (width, height) of the PNG. view_mb: megabytes of the 3D view. scale_m: depths
        at the ends of the colours. map: texts of the improvement map. None where there is none.
    """
    files = {kind: request.output / path for kind, path in result.outputs.items()}
    figures = result.figures
    are_all_there = all(kind in files and files[kind].exists() for kind in figures)
    if "preview" not in figures or not are_all_there:
        return {"key": None}
    # The start of its images' names: fit for a file, and of this frame alone.
    digest = hashlib.sha256(name.encode("utf-8", "surrogateescape")).hexdigest()
    key = digest[:_KEY_LENGTH]
    # The PNGs, and where each view of the page lies in them.
    views = dict[str, object]()
    for kind, figure in figures.items():
        file = f"{key}_{kind}.png"
        report.link_image(files[kind], images / file)
        for view, title in _LABELS.items():
            if title in figure.panels:
                views[view] = {
                    "src": f"{report.IMAGES}/{file}",
                    "box": figure.panels[title],
                    "size": figure.size,
                }
    # The 3D view, and the texts of the improvement map.
    view_mb = None
    if request.html_3d and "view" in files:
        view_mb = report.save_view_3d(files["view"], images / f"{key}_view.js")
    improvement = figures.get("improvement")
    map_entry = None
    if improvement is not None:
        map_entry = {
            "ends": improvement.ends,
            "unknown": improvement.unknown,
            "footer": improvement.footer,
        }
    scale_m = figures["preview"].scale_m
    return {"key": key, "views": views, "view_mb": view_mb, "scale_m": scale_m, "map": map_entry}


def _columns(basis: str, unit: str) -> list[Measure]:
    """The columns of the page's table: errors before and after, and their changes.

    A change at the points that were used means nothing, so there is none on that basis.

    Args:
        basis: What the errors are measured on, a key of `measures.BASES`.
        unit: Unit of the depths.
    """
    keys = ("mae",) if basis == VALIDATION else ("rmse", "mae")  # validation points have no RMSE
    columns = []
    for measure in choose_measures(MEASURES, keys):
        change, before, after = (
            replace(
                measure, key=f"{measure.key}_{column}", title=f"{measure.title} {column}", unit=unit
            )
            for column in (_CHANGE, BEFORE, AFTER)
        )
        if basis != USED:
            columns.append(replace(change, unit="", percent=True, decimals=1))
        columns += [before, after]
    return columns


def _values(stages: dict[str, Scores]) -> dict[str, float | None]:
    """The values of all columns that `_columns` may have, by key; None for what is unknown.

    Args:
        stages: Errors before and after, by stage.
    """
    values = dict[str, float | None]()
    for key in ("rmse", "mae"):
        before = stages[BEFORE].get(key)
        after = stages[AFTER].get(key)
        change = None
        if before and after is not None:  # of an error that was 0 there is no fraction
            change = after / before - 1
        values |= {f"{key}_{BEFORE}": before, f"{key}_{AFTER}": after, f"{key}_{_CHANGE}": change}
    return values


def _notes(record: FrameRecord, basis: str) -> list[str]:
    """What the page says below a frame: why it diverged, what its errors are of, and warnings.

    Args:
        record: Record of the frame.
        basis: What its errors are measured on, a key of `measures.BASES`; empty if it has none.
    """
    notes = [record.message] if record.message else []
    if basis:
        after = record.errors[basis][AFTER]
        count = f"{after['pixels']:,} pixels" if basis == GT else f"{after['points']:,} points"
        notes.append(f"Errors are {BASES[basis]}, {count}.")
    if basis == USED:
        notes.append("Refinement fits these points, so the change there proves nothing.")
    if record.result is not None and record.result.weights:
        notes.append(f"Weights: {weights_text(record.result.weights)}.")
    return [*notes, *record.warnings]


def _facts(summary: BatchSummary, of_first: Mapping[str, object]) -> list[tuple[str, str]]:
    """What was refined, and how: names and texts, such as the settings that decide the results.

    Args:
        summary: The batch's summary.
        of_first: The settings of the first result, with nothing left open.
    """
    counts = summary.counts
    frames = [
        f"{counts[status]:,} {status.replace('_', ' ')}"
        for status in ("done", "diverged", "failed", "pending", "with_warnings")
        if counts[status]
    ]
    facts = [
        ("frames of", f"{summary.source} (layout {summary.layout})"),
        ("frames", ", ".join(frames)),
        ("results in", summary.output),
        ("method", summary.method),
    ]
    if summary.weights:
        facts.append(("mean weights", mean_weights_text(summary.weights)))
    settings = {**summary.settings, **of_first}
    facts += [(name, str(settings[name])) for name in _SETTINGS if settings.get(name)]
    return facts
