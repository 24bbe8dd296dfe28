"""`pnpdepth batch --html`: each frame before and after refinement, with a map of the change.

Everything is read from the results on disk: scores from the rows of the summary, images from the
panels of the previews and the improvement maps. So a report also has the frames of earlier runs. An
image is named after the files it is made of, so that it is made once.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pnpdepth_cli.core.metrics import MEASURES, Measure
from pnpdepth_cli.errors import InputError, OutputError
from pnpdepth_cli.io.fingerprint import fingerprint
from pnpdepth_cli.io.page import SavedPage, open_page
from pnpdepth_cli.io.report import (
    IMAGES,
    begin_report,
    check_report_folder,
    image_key,
    write_report,
)
from pnpdepth_cli.io.report_images import gain_colours, image_paths, save_images
from pnpdepth_cli.io.report_view import megabytes, save_view, view_path
from pnpdepth_cli.pipeline.evaluation.score_files import column_title, format_value
from pnpdepth_cli.pipeline.ordered_pool import in_order
from pnpdepth_cli.pipeline.report.columns import (
    Column,
    column_of,
    figures,
    frames_text,
    table,
    tile,
)

Row = dict[str, Any]

_PANELS = {
    "Depth before": "first",
    "Depth after": "second",
    "Change of error": "map",
    "Image": "image",
    "Sparse depth": "sparse",
}
_GT, _HELD_OUT, _USED = "scores", "held_out_error", "sparse_error"
_BASES = {
    _GT: "against ground truth",
    _HELD_OUT: "at held-out points",
    _USED: "at the points used",
}
"""What errors are measured on, the best first. A gain at the points used means nothing."""
_ERRORS = {measure.key: measure for measure in MEASURES if measure.key in ("rmse", "mae")}


@dataclass(frozen=True, kw_only=True)
class BatchReport:
    """Writes the report of a batch."""

    folder: Path
    """Where the report is written."""
    output: Path
    """The folder of the results."""
    workers: int
    """Threads that draw."""
    view_3d: bool = False
    """Whether the frames have 3D views."""
    colors: str = "blue-orange"
    """Colours of the improvement maps."""

    def check(self, inputs: Sequence[Path], *, overwrite: bool) -> None:
        """Raises OutputError for a folder that the report cannot or may not be written to."""
        folder, output = self.folder.resolve(), self.output.resolve()
        if output.is_relative_to(folder):
            raise OutputError(
                f"{self.folder} holds the results; name a folder of its own for the report, such as"
                f" {self.output / 'report'}"
            )
        others = [path for path in inputs if not _holds_results(path, output, folder)]
        check_report_folder(self.folder, others, made_of=self._source(), overwrite=overwrite)

    def begin(self) -> None:
        """Creates the folder, marked so that the next run may replace it."""
        begin_report(self.folder, self._source())

    def drawn(self, row: Row) -> Row:
        """Writes the images of the row's frame, if it has results; returns the row."""
        if row["outputs"]:
            self._draw(row)
        return row

    def write(self, summary: Mapping[str, Any], rows: Callable[[], Iterable[Row]]) -> None:
        """Writes the page.

        Args:
            summary: The batch's summary without its frames.
            rows: Gives the summary's rows, each time anew.
        """
        overview = _Overview.of(rows())
        measured = any(summary["mean"][basis] for basis in (_GT, _HELD_OUT))
        columns = _columns(measured)

        def entry(row: Row) -> dict[str, Any]:
            return self._entry(row, columns, measured, mixed=len(overview.bases) > 1)

        results = (row for row in rows() if row["outputs"])
        entries = in_order(entry, results, self.workers)
        head = _head(summary, overview, columns, measured)
        head["map_colours"] = gain_colours(self.colors)
        write_report(self.folder, head, entries, viewer=self.view_3d)

    def _source(self) -> dict[str, Any]:
        folder, output = self.folder.resolve(), self.output.resolve()
        return {"command": "batch", "output": os.path.relpath(output, folder)}

    def _draw(self, row: Row) -> dict[str, Any]:
        """As `drawn`; returns the page's entry of the images."""
        files = [row["outputs"].get(kind) for kind in ("preview", "improvement")]
        if None in files:
            return {"key": None}
        paths = [self.output / name for name in files]
        try:
            view = self._view_of(row)
            made_of = [*paths, *([] if view is None else [view])]
            key = image_key(*(fingerprint(path).sha256 for path in made_of))
            preview, improvement = (open_page(path) for path in paths)
            views = _views(preview, improvement)
            images = self.folder / IMAGES
            if not all(path.exists() for path in image_paths(images, key, views)):
                panels = preview.panels() | improvement.panels()
                named = {_PANELS[title]: panels[title] for title in panels if title in _PANELS}
                thumb = "image" if "image" in views else "second"
                save_images(images, key, named, thumb=thumb)
            script = view_path(images, key)
            if view is not None and not script.exists():
                save_view(view, script)
        except InputError:  # a result has gone or changed; the next run refines it again
            return {"key": None}
        return {
            "key": key,
            "views": views,
            "view_mb": None if view is None else megabytes(script),
            "scale_m": [preview.content["low_m"], preview.content["high_m"]],
            "map": {name: improvement.content[name] for name in ("ends", "unknown", "footer")},
        }

    def _view_of(self, row: Row) -> Path | None:
        """The 3D view of the row's frame."""
        name = row["outputs"].get("view") if self.view_3d else None
        return None if name is None else self.output / name

    def _entry(
        self, row: Row, columns: list[Column], measured: bool, *, mixed: bool
    ) -> dict[str, Any]:
        basis = _basis(row)
        values = _values(row, basis, measured)
        tag = _BASES[basis] if mixed and basis else ""
        return {
            "name": row["name"],
            "values": [values.get(column.key) for column in columns],
            "notes": list(_notes(row, basis)),
            "tag": "diverged" if row["status"] == "diverged" else tag,
            **self._draw(row),
        }


@dataclass(frozen=True, kw_only=True)
class _Overview:
    """What all rows together say."""

    bases: frozenset[str]
    """What the frames' errors are measured on, keys of _BASES."""
    first: Row | None
    """The first row with results."""
    failed: list[dict[str, str]]
    """Name and reason of each frame without results."""

    @classmethod
    def of(cls, rows: Iterable[Row]) -> _Overview:
        bases, failed, first = set[str](), [], None
        for row in rows:
            if row["outputs"]:
                first = first or row
                bases.add(_basis(row) or "")
            else:
                failed.append({"name": row["name"], "reason": row["message"]})
        return cls(bases=frozenset(bases - {""}), first=first, failed=failed)


def _holds_results(path: Path, output: Path, folder: Path) -> bool:
    """True for a folder that holds the results, if the report is among them too."""
    return folder.is_relative_to(output) and output.is_relative_to(path.resolve())


def _views(preview: SavedPage, improvement: SavedPage) -> list[str]:
    titles = [panel["title"] for page in (preview, improvement) for panel in page.content["panels"]]
    return [view for title, view in _PANELS.items() if title in titles]


def _basis(row: Row) -> str | None:
    return next((basis for basis in _BASES if row[basis]), None)


def _columns(measured: bool) -> list[Column]:
    """Errors before and after; with gains if any frame has ground truth or held-out points."""
    columns = []
    for key, measure in _ERRORS.items():
        if measured:
            title = f"{measure.title} gain"
            columns.append(
                Column(
                    key=f"{key}_gain", title=title, decimals=1, percent=True, signed=True,
                    higher_is_better=True,
                )
            )  # fmt: skip
        for stage in ("before", "after"):
            title, name = f"{measure.title} {stage}", f"{key}_{stage}"
            columns.append(column_of(measure, title=title, key=name, listed=True))
    improved = Column(
        key="improved", title="Improved", decimals=1, percent=True, higher_is_better=True
    )
    return [*columns, improved]


def _values(row: Row, basis: str | None, measured: bool) -> dict[str, float | None]:
    if basis is None or (measured and basis == _USED):
        return {}
    values: dict[str, float | None] = {
        "improved": row.get("improved_fraction", row.get("improved_share"))
    }
    for key in _ERRORS:
        before, after = (row[basis][stage].get(key) for stage in ("before", "after"))
        values |= {f"{key}_before": before, f"{key}_after": after}
        values[f"{key}_gain"] = _gain(before, after)
    return values


def _gain(before: float | None, after: float | None) -> float | None:
    return 1 - after / before if before and after is not None else None


def _notes(row: Row, basis: str | None) -> Iterator[str]:
    if row["message"]:
        yield row["message"]
    if basis is not None:
        after = row[basis]["after"]
        count = f"{after['pixels']:,} pixels" if basis == _GT else f"{after['points']:,} points"
        yield f"Errors are {_BASES[basis]}, {count}."
    if basis == _USED:
        yield "Refinement fits these points, so its gain there proves nothing."
    yield from row["warnings"]


def _head(
    summary: Mapping[str, Any], overview: _Overview, columns: list[Column], measured: bool
) -> dict[str, Any]:
    unmatched = len(summary["unmatched"])
    return {
        "kind": "Batch refinement",
        "title": summary["output"],
        "tiles": _tiles(summary, measured),
        "facts": _facts(summary, overview.first),
        "notes": [f"warning: {unmatched:,} files are in no frame; summary.json has them"]
        if unmatched
        else [],
        "tables": [
            each
            for basis in _BASES
            if summary["mean"][basis]
            for each in [_means(basis, summary["mean"][basis])]
        ]
        + _baselines(summary.get("baselines"), summary["unit"]),
        "labels": {
            "first": "Before",
            "second": "After",
            "map": "Change of error",
            "image": "Image",
            "sparse": "Sparse depth",
            "gt": "Ground truth",
        },
        "without_title": f"Not refined: {len(overview.failed):,}",
        "without": overview.failed,
        **figures(columns, "rmse_gain" if measured else "rmse_after"),
    }


def _tiles(summary: Mapping[str, Any], measured: bool) -> list[dict[str, str]]:
    counts = summary["counts"]
    refined = counts["done"] + counts["diverged"]
    others = [
        f"{counts[kind]:,} {kind}" for kind in ("diverged", "failed", "pending") if counts[kind]
    ]
    tiles = [tile("Frames refined", f"{refined:,} of {counts['frames']:,}", ", ".join(others))]
    for basis in (_GT, _HELD_OUT) if measured else (_USED,):
        mean = summary["mean"][basis]
        for key, measure in _ERRORS.items() if mean else ():
            before, after = (mean[stage].get(key) for stage in ("before", "after"))
            change = f"{format_value(measure, before)} → {format_value(measure, after)}"
            gain = _gain(before, after)
            gain_text = ""
            if gain is not None and basis != _USED:
                gain_text = f"gain {_signed(100 * gain, 1, '%')} "
            tiles.append(
                tile(f"{measure.title} [{summary['unit']}]", change, f"{gain_text}{_BASES[basis]}")
            )
    return tiles


def _facts(summary: Mapping[str, Any], first: Row | None) -> list[list[str]]:
    settings = summary["settings"]
    facts = [
        ["Frames of", f"{summary['source']} (layout {summary['layout']})"],
        ["Results in", summary["output"]],
        ["Network", str(settings["model"])],
    ]
    if summary["method"]["kind"] == "chosen":
        facts.append(["Refinement", "each frame by its best candidate at held-out points"])
    elif first is not None:
        used = first["settings"]
        refined = f"{used['iterations']} updates of z at {used['layer']}"
        facts.append(
            ["Refinement", f"{refined} ({used['update']}, {used['loss']}, step {used['lr']})"]
        )
        facts.append(["Alignment", str(used["align"])])
    if settings["propagate"]:
        facts.append(["Propagation", settings["propagate"]])
    if settings["holdout"]:
        facts.append(
            ["Held out", f"{settings['holdout']:.0%} of the points, seed {settings['seed']}"]
        )
    if summary["counts"]["with_warnings"]:
        facts.append(["Warnings", f"in {frames_text(summary['counts']['with_warnings'])}"])
    return facts


def _means(basis: str, mean: Mapping[str, Any]) -> dict[str, Any]:
    measures: Iterable[Measure] = MEASURES if basis == _GT else _ERRORS.values()
    header = ["", "before", "after", *([] if basis == _USED else ["gain"])]
    rows = []
    for measure in measures:
        before, after = (mean[stage].get(measure.key) for stage in ("before", "after"))
        row = [column_title(measure), format_value(measure, before), format_value(measure, after)]
        if basis != _USED:
            row.append(_gain_text(measure, before, after))
        rows.append(row)
    if basis == _GT:
        rows.append(
            [
                "coverage",
                *(_percent(mean[stage].get("coverage")) for stage in ("before", "after")),
                "",
            ]
        )
    return table(f"Means over {frames_text(mean['frames'])}, {_BASES[basis]}", header, rows)


def _baselines(mean: Mapping[str, Mapping[str, Any]] | None, unit: str) -> list[dict[str, Any]]:
    """A table of the simple baselines, the network and the result; empty without --baselines."""
    if not mean:
        return []
    mae = _ERRORS["mae"]
    header = ["", f"MAE at held-out points [{unit}]", "MAE [m]", "RMSE [m]", "frames"]
    rows = [
        [name, *(format_value(mae, row[key]) for key in ("held_out_mae", "mae", "rmse")),
         f"{row['frames']:,}"]
        for name, row in mean.items()
    ]  # fmt: skip
    return [table("Simple baselines: means over frames", header, rows)]


def _percent(value: float | None) -> str:
    return "–" if value is None else f"{value:.2%}"


def _gain_text(measure: Measure, before: float | None, after: float | None) -> str:
    if before is None or after is None:
        return "–"
    if measure.percent:
        return _signed(100 * (after - before), 2, " pt")
    gain = _gain(before, after)
    return "–" if gain is None else _signed(100 * gain, 1, "%")


def _signed(value: float, decimals: int, unit: str) -> str:
    """The value with its sign; without one if it is rounded to zero."""
    text = f"{abs(value):.{decimals}f}"
    sign = "" if float(text) == 0 else "+" if value > 0 else "−"
    return f"{sign}{text}{unit}"
