"""`pnpdepth batch --html`: each frame before and after refinement.

Everything is read from the results on disk: scores from the rows of the summary, images from the
previews and, with ground truth, the improvement maps, which the report links as they were written.
The records say where their panels are. So a report also has the frames of earlier runs.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from pnpdepth_cli.commands.batch.batch_request import BatchRequest
from pnpdepth_cli.commands.batch.records import BatchSummary
from pnpdepth_cli.commands.tables import bases_of, mean_weights_text, means_tables, weights_text
from pnpdepth_cli.dataset.frame_record import FrameRecord, Scores
from pnpdepth_cli.errors import OutputError
from pnpdepth_cli.io import report
from pnpdepth_cli.measures import MEASURES, Measure, choose_measures
from pnpdepth_cli.stages import AFTER, BASES, BEFORE, GT, USED, VALIDATION

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
_SETTINGS = (
    *("model", "layer", "iterations", "lr", "loss", "update", "align", "propagate", "holdout"),
    "seed",
)


def check_batch_report(request: BatchRequest, folder: Path) -> None:
    """Raises OutputError for a folder that the report cannot or may not be written to.

    Args:
        request: Request of the batch.
        folder: Folder of the report.
    """
    output = Path(os.path.realpath(request.output))
    if output.is_relative_to(os.path.realpath(folder)):
        own = request.output / "report"
        raise OutputError(f"{folder} holds the results; name another folder, such as {own}")
    source, overwrite = _source(request, folder), request.refine.overwrite
    report.check_report_folder(folder, source, overwrite=overwrite)


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
    results = [record for record in records if record.outputs]
    basis = next(iter(bases_of(summary.errors)), USED)
    columns, notes = _columns(basis, summary.unit), [*summary.notes]
    if summary.unmatched:
        unmatched = f"{len(summary.unmatched):,} files"
        notes.append(f"warning: {unmatched} are in no frame; summary.json has them")
    if results and basis == USED:
        notes.append("Without ground truth or --holdout, no error is measured.")
    keys = [measure.key for measure in columns]
    page = {
        "title": summary.output,
        "facts": _facts(summary, results),
        "notes": notes,
        "tables": means_tables(summary.errors, summary.unit, summary.titles, summary.columns),
        "without": [(each.name, each.message or "") for each in records if not each.outputs],
    }
    data = {
        "columns": [measure.to_json() for measure in columns],
        "sort_by": keys.index("rmse_after") if basis == USED else 0,
        "signed": [key for key in keys if key.endswith(_CHANGE)],
        "unit": summary.unit,
    }

    def entries(images: Path) -> Iterator[dict[str, object]]:
        for record in results:
            yield _entry(record, basis, columns) | _views(record, request, images)

    source = _source(request, folder)
    report.write_report(folder, source, page, data, entries, viewer=request.html_3d)


def _source(request: BatchRequest, folder: Path) -> dict[str, object]:
    """What the report is made of."""
    output = os.path.relpath(os.path.realpath(request.output), os.path.realpath(folder))
    return {"command": "batch", "output": output}


def _entry(record: FrameRecord, basis: str, columns: Sequence[Measure]) -> dict[str, object]:
    """A frame's values on the basis of all frames; where it has none, what it has instead."""
    own = basis if basis in record.errors else next(iter(bases_of(record.errors)), "")
    values = _values(record.errors[basis]) if own == basis else {}
    tag = BASES[own] if own not in ("", basis) else ""
    return {
        "name": record.name,
        "values": [values.get(measure.key) for measure in columns],
        "notes": _notes(record, own),
        "tag": "diverged" if record.status == "diverged" else tag,
    }


def _views(record: FrameRecord, request: BatchRequest, images: Path) -> dict[str, object]:
    """Links the images of a frame, unless they were deleted; returns the page's entry of them."""
    files = {kind: request.output / path for kind, path in record.outputs.items()}
    views, figures = dict[str, object](), record.figures
    there = all(kind in files and files[kind].exists() for kind in figures)
    if "preview" not in figures or not there:
        return {"key": None}
    # The start of its images' names: fit for a file, and of this frame alone.
    key = hashlib.sha256(record.name.encode("utf-8", "surrogateescape")).hexdigest()[:20]
    for kind, figure in figures.items():
        name = f"{key}_{kind}.png"
        report.link_image(files[kind], images / name)
        for view, title in _LABELS.items():
            if title in figure.panels:
                box, src = figure.panels[title], f"{report.IMAGES}/{name}"
                views[view] = {"src": src, "box": box, "size": figure.size}
    view_mb = None
    if request.html_3d and "view" in files:
        view_mb = report.save_view_3d(files["view"], images / f"{key}_view.js")
    gains = figures.get("improvement")
    of_gains = gains and {"ends": gains.ends, "unknown": gains.unknown, "footer": gains.footer}
    scale_m = figures["preview"].scale_m
    return {"key": key, "views": views, "view_mb": view_mb, "scale_m": scale_m, "map": of_gains}


def _columns(basis: str, unit: str) -> list[Measure]:
    """Errors before and after on a basis; with changes unless it is the points used."""
    columns = []
    for m in choose_measures(MEASURES, ("mae",) if basis == VALIDATION else ("rmse", "mae")):
        change, *stages = (
            replace(m, key=f"{m.key}_{part}", title=f"{m.title} {part}", unit=unit)
            for part in (_CHANGE, BEFORE, AFTER)
        )
        change = replace(change, unit="", percent=True, decimals=1)
        columns += stages if basis == USED else [change, *stages]
    return columns


def _values(stages: dict[str, Scores]) -> dict[str, float | None]:
    values = dict[str, float | None]()
    for key in ("rmse", "mae"):
        before, after = (stages[stage].get(key) for stage in (BEFORE, AFTER))
        change = after / before - 1 if before and after is not None else None
        values |= {f"{key}_before": before, f"{key}_after": after, f"{key}_{_CHANGE}": change}
    return values


def _notes(record: FrameRecord, basis: str) -> list[str]:
    notes = [record.message] if record.message else []
    if basis:
        after = record.errors[basis][AFTER]
        count = f"{after['pixels']:,} pixels" if basis == GT else f"{after['points']:,} points"
        notes.append(f"Errors are {BASES[basis]}, {count}.")
    if basis == USED:
        notes.append("Refinement fits these points, so the change there proves nothing.")
    if record.weights:
        notes.append(f"Weights: {weights_text(record.weights)}.")
    return [*notes, *record.warnings]


def _facts(summary: BatchSummary, results: Sequence[FrameRecord]) -> list[tuple[str, str]]:
    """What was refined, and how: the settings that decide the results, by their options."""
    counts = summary.counts
    settings = dict(summary.settings)
    if results:
        settings |= results[0].settings
    frames = [
        f"{counts[kind]:,} {kind.replace('_', ' ')}"
        for kind in ("done", "diverged", "failed", "pending", "with_warnings")
        if counts[kind]
    ]
    weights = summary.weights
    return [
        ("frames of", f"{summary.source} (layout {summary.layout})"),
        ("frames", ", ".join(frames)),
        ("results in", summary.output),
        ("method", summary.method),
        *([("mean weights", mean_weights_text(weights))] if weights else []),
        *((name, str(settings[name])) for name in _SETTINGS if settings.get(name)),
    ]
