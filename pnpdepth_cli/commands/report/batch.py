"""`pnpdepth batch --html`: each frame before and after refinement, with a map of the change.

Everything is read from the results on disk: scores from the rows of the summary, images from the
previews and the improvement maps, which the report links as they were written. So a report also has
the frames of earlier runs.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from pnpdepth_cli.commands.report.evaluation import column_of, frames_text
from pnpdepth_cli.commands.tables import Table, column_title, format_value
from pnpdepth_cli.core.metrics import MEASURES, Measure
from pnpdepth_cli.errors import InputError, OutputError
from pnpdepth_cli.io.colours import hex_colours, signed_bar
from pnpdepth_cli.io.figure import figure_content
from pnpdepth_cli.io.report import (
    IMAGES,
    Column,
    Head,
    begin_report,
    check_report_folder,
    image_key,
    link_image,
    save_view_3d,
    write_report,
)

Row = Mapping[str, Any]

_PANELS = {
    "Depth before": "first",
    "Depth after": "second",
    "Change of error": "map",
    "Image": "image",
    "Sparse depth": "sparse",
}
_LABELS = {
    "first": "Before",
    "second": "After",
    "map": "Change of error",
    "image": "Image",
    "sparse": "Sparse depth",
    "gt": "Ground truth",
}
_GT, _HELD_OUT, _HIDDEN, _USED = "scores", "held_out_error", "check", "sparse_error"
_BASES = {
    _GT: "against ground truth",
    _HELD_OUT: "at held-out points",
    _HIDDEN: "at points hidden for the check",
    _USED: "at the points used",
}
"""What errors are measured on, the best first. A gain at the points used means nothing."""
_ERRORS = {measure.key: measure for measure in MEASURES if measure.key in ("rmse", "mae")}


@dataclass(frozen=True, kw_only=True)
class BatchReport:
    """Writes the report of a batch."""

    folder: Path
    output: Path
    """The folder of the results."""
    view_3d: bool = False
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

    def write(self, summary: Mapping[str, Any], rows: Callable[[], Iterable[Row]]) -> None:
        """Writes the page, and links the images of all frames.

        Args:
            summary: The batch's summary without its frames.
            rows: Gives the summary's rows, each time anew.
        """
        bases, failed, first = set[str | None](), [], None
        for row in rows():
            if row["outputs"]:
                first = first or row
                bases.add(_basis(row))
            else:
                failed.append((row["name"], row["message"]))
        bases.discard(None)
        head, mixed = _head(summary, first, failed, self.colors), len(bases) > 1
        entries = (self._entry(row, head.columns, mixed) for row in rows() if row["outputs"])
        write_report(self.folder, head, entries, viewer=self.view_3d)

    def _source(self) -> dict[str, Any]:
        folder, output = self.folder.resolve(), self.output.resolve()
        return {"command": "batch", "output": os.path.relpath(output, folder)}

    def _entry(self, row: Row, columns: Sequence[Column], mixed: bool) -> dict[str, Any]:
        basis = _basis(row)
        values = _values(row, basis)
        if basis == _USED and columns[0].signed:
            values = {}  # others have a gain that means something
        tag = _BASES[basis] if mixed and basis else ""
        try:
            views = self._views(row)
        except InputError:  # a result has gone or changed; the next run refines it again
            views = {"key": None}
        return {
            "name": row["name"],
            "values": [values.get(column.key) for column in columns],
            "notes": list(_notes(row, basis)),
            "tag": "diverged" if row["status"] == "diverged" else tag,
            **views,
        }

    def _views(self, row: Row) -> dict[str, Any]:
        """Links the images of the row's frame; returns the page's entry of them."""
        files = {kind: self.output / path for kind, path in row["outputs"].items()}
        if not ("preview" in files and "improvement" in files):
            return {"key": None}
        key, views, figures = image_key(row["name"]), {}, {}
        for kind in ("preview", "improvement"):
            figure = figures[kind] = figure_content(files[kind])
            name = f"{IMAGES}/{key}_{kind}.png"
            link_image(files[kind], self.folder / name)
            for panel in figure["panels"]:
                if panel["title"] in _PANELS:
                    place = {"src": name, "box": panel["box"], "size": figure["size"]}
                    views[_PANELS[panel["title"]]] = place
        view_mb = None
        if self.view_3d and "view" in files:
            view_mb = save_view_3d(files["view"], self.folder / IMAGES / f"{key}_view.js")
        return {
            "key": key,
            "views": views,
            "view_mb": view_mb,
            "scale_m": [figures["preview"][end] for end in ("low_m", "high_m")],
            "map": {name: figures["improvement"][name] for name in ("ends", "unknown", "footer")},
        }


def _holds_results(path: Path, output: Path, folder: Path) -> bool:
    """True for a folder that holds the results, if the report is among them too."""
    return folder.is_relative_to(output) and output.is_relative_to(path.resolve())


def _basis(row: Row) -> str | None:
    return next((basis for basis in _BASES if _errors(row, basis)), None)


def _errors(row: Row, basis: str) -> Mapping[str, Any] | None:
    """The errors of a row before and after, measured on that basis."""
    if basis != _HIDDEN:
        errors: Mapping[str, Any] | None = row[basis]
        return errors
    check = (row["linear"] or {}).get("check")
    return check and {
        stage: {"mae": check[name], "points": check["points"]}
        for stage, name in (("before", "aligned"), ("after", "result"))
    }


def _columns(best: str, unit: str) -> list[Column]:
    """Errors before and after on the best basis; with gains unless it is the points used."""
    columns = []
    percent: dict[str, Any] = {"decimals": 1, "percent": True, "higher_is_better": True}
    for measure in _measures(best):
        key = measure.key
        if best != _USED:
            title = f"{measure.title} gain"
            columns.append(Column(key=f"{key}_gain", title=title, signed=True, **percent))
        for stage in ("before", "after"):
            title, name = f"{measure.title} {stage}", f"{key}_{stage}"
            columns.append(column_of(in_unit(measure, unit), title=title, key=name, listed=True))
    if best != _HIDDEN:  # the map is then of the points used
        columns.append(Column(key="improved", title="Improved", **percent))
    return columns


def _values(row: Row, basis: str | None) -> dict[str, float | None]:
    if basis is None:
        return {}
    errors = _errors(row, basis)
    assert errors is not None
    values: dict[str, float | None] = {"improved": row.get("improved_fraction")}
    for key in _ERRORS:
        before, after = (errors[stage].get(key) for stage in ("before", "after"))
        values |= {f"{key}_before": before, f"{key}_after": after}
        values[f"{key}_gain"] = _gain(before, after)
    return values


def _gain(before: float | None, after: float | None) -> float | None:
    return 1 - after / before if before and after is not None else None


def _notes(row: Row, basis: str | None) -> Iterator[str]:
    if row["message"]:
        yield row["message"]
    if basis is not None:
        errors = _errors(row, basis)
        assert errors is not None
        after = errors["after"]
        count = f"{after['pixels']:,} pixels" if basis == _GT else f"{after['points']:,} points"
        yield f"Errors are {_BASES[basis]}, {count}."
    if basis == _USED:
        yield "Refinement fits these points, so its gain there proves nothing."
    yield from row["warnings"]


def _head(
    summary: Mapping[str, Any], first: Row | None, failed: list[tuple[str, str]], colors: str
) -> Head:
    unit, unmatched, notes = summary["unit"], len(summary["unmatched"]), []
    means = _mean_errors(summary)
    best = next(iter(means), _USED)
    if unmatched:
        notes = [f"warning: {unmatched:,} files are in no frame; summary.json has them"]
    if means and best == _USED:
        notes.append("Without ground truth or --holdout, no error is measured.")
    columns = _columns(best, unit)
    return Head(
        kind="Batch refinement",
        title=summary["output"],
        tiles=_tiles(summary, means),
        facts=_facts(summary, first),
        notes=notes,
        tables=[
            *(_means(basis, mean, unit, _linear(summary, basis)) for basis, mean in means.items()),
            *_baselines(summary.get("baselines"), unit),
        ],
        without_title=f"Not refined: {len(failed):,}",
        without=failed,
        columns=columns,
        sort_by="rmse_after" if best == _USED else columns[0].key,
        labels=_LABELS,
        thumb="second",
        map_colours=hex_colours(signed_bar(colors, 9)),
        unit=unit,
    )


def _mean_errors(summary: Mapping[str, Any]) -> dict[str, Mapping[str, Any]]:
    """The mean errors before and after by basis, the best first; hidden points if nothing else."""
    means: dict[str, Any] = {basis: summary["mean"].get(basis) for basis in _BASES}
    check = summary["linear"]["check"]
    if check and not (means[_GT] or means[_HELD_OUT]):
        stages = {stage: {"mae": check[stage]} for stage in ("before", "after")}
        means[_HIDDEN] = {"frames": check["frames"], **stages}
    return {basis: mean for basis, mean in means.items() if mean}


def _linear(summary: Mapping[str, Any], basis: str) -> Mapping[str, Any]:
    """The mean errors of linear interpolation of the points; empty at the points themselves."""
    found = summary["linear"].get(basis) or {}
    return {"mae": found["linear"]} if basis == _HIDDEN and found else found


def _tiles(
    summary: Mapping[str, Any], means: Mapping[str, Mapping[str, Any]]
) -> list[tuple[str, str, str]]:
    """The number of frames, and errors that were not measured at the points used."""
    counts = summary["counts"]
    refined = counts["done"] + counts["diverged"]
    others = [
        f"{counts[kind]:,} {kind}" for kind in ("diverged", "failed", "pending") if counts[kind]
    ]
    tiles = [("Frames refined", f"{refined:,} of {counts['frames']:,}", ", ".join(others))]
    for basis, mean in means.items():
        for measure in _measures(basis) if basis != _USED else ():
            before, after, gain = _changed(measure, mean)
            label = f"{measure.title} [{summary['unit']}]"
            linear = _linear(summary, basis).get(measure.key)
            beside = "" if linear is None else f"; linear {format_value(measure, linear)}"
            tiles.append((label, f"{before} → {after}", f"gain {gain} {_BASES[basis]}{beside}"))
    return tiles


def _facts(summary: Mapping[str, Any], first: Row | None) -> list[tuple[str, str]]:
    settings = summary["settings"]
    facts = [
        ("Frames of", f"{summary['source']} (layout {summary['layout']})"),
        ("Results in", summary["output"]),
        ("Network", str(settings["model"])),
    ]
    if summary["method"]["kind"] == "default":
        facts.append(("Refinement", "networks refined, fused and propagated (the default method)"))
    elif first is not None:
        used = first["settings"]
        refined = f"{used['iterations']} updates of z at {used['layer']}"
        facts.append(
            ("Refinement", f"{refined} ({used['update']}, {used['loss']}, step {used['lr']})")
        )
        facts.append(("Alignment", str(used["align"])))
    if settings["propagate"]:
        facts.append(("Propagation", settings["propagate"]))
    if settings["holdout"]:
        held_out = f"{settings['holdout']:.0%} of the points, seed {settings['seed']}"
        facts.append(("Held out", held_out))
    if summary["counts"]["with_warnings"]:
        facts.append(("Warnings", f"in {frames_text(summary['counts']['with_warnings'])}"))
    return facts


def _means(basis: str, mean: Mapping[str, Any], unit: str, linear: Mapping[str, Any]) -> Table:
    measures = MEASURES if basis == _GT else _measures(basis)
    rows = [
        [
            column_title(in_unit(each, unit)),
            *_changed(each, mean),
            format_value(each, linear.get(each.key)),
        ]
        for each in measures
    ]
    if basis == _GT:
        before, after, beside = (
            "–" if errors.get("coverage") is None else f"{errors['coverage']:.2%}"
            for errors in (mean["before"], mean["after"], linear)
        )
        rows.append(["coverage", before, after, "", beside])
    shown = 3 if basis == _USED else 5  # neither gain nor linear means anything at the points used
    return Table(
        caption=f"Means over {frames_text(mean['frames'])}, {_BASES[basis]}",
        header=["", "before", "after", "gain", "linear"][:shown],
        rows=[row[:shown] for row in rows],
    )


def _measures(basis: str) -> list[Measure]:
    return [_ERRORS["mae"]] if basis == _HIDDEN else [*_ERRORS.values()]


def _changed(measure: Measure, mean: Mapping[str, Any]) -> tuple[str, str, str]:
    """The mean before and after, and its gain; a gain without sign is rounded to zero."""
    before, after = (mean[stage].get(measure.key) for stage in ("before", "after"))
    gain, decimals, unit = _gain(before, after), 1, "%"
    if measure.percent and before is not None and after is not None:
        gain, decimals, unit = after - before, 2, " pt"
    text = "–"
    if gain is not None:
        size = f"{100 * abs(gain):.{decimals}f}"
        text = f"{'' if float(size) == 0 else '+' if gain > 0 else '−'}{size}{unit}"
    return format_value(measure, before), format_value(measure, after), text


def _baselines(mean: Mapping[str, Mapping[str, Any]] | None, unit: str) -> list[Table]:
    """A table of the simple baselines, the network and the result; empty without --baselines."""
    if not mean:
        return []
    places = {"held_out_mae": "MAE at held-out points", "mae": "MAE", "rmse": "RMSE"}
    rows = [
        [name, *(format_value(_ERRORS["mae"], row[key]) for key in places), f"{row['frames']:,}"]
        for name, row in mean.items()
    ]
    header = ["", *(f"{title} [{unit}]" for title in places.values()), "frames"]
    return [Table(caption="Simple baselines: means over frames", header=header, rows=rows)]


def in_unit(measure: Measure, unit: str) -> Measure:
    """Returns the measure of depths whose unit is not the metre, such as a model's."""
    return replace(measure, unit=unit) if measure.unit == "m" else measure
