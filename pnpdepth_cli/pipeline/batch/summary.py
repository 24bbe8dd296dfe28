"""What became of a batch: `summary.json` and `summary.csv`, written frame by frame."""

from __future__ import annotations

import csv
import json
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from pnpdepth_cli.io.atomic import atomic_path
from pnpdepth_cli.io.csv_text import text_cell
from pnpdepth_cli.io.record import plain

CSV, JSON = "summary.csv", "summary.json"

_POINT_ERRORS = ("mae", "rmse")
_SCORES = (
    *("rmse", "mae", "mre", "sq_rel", "log10", "rmse_log", "irmse", "imae", "silog"),
    *("delta1", "delta2", "delta3", "coverage"),
)
_MEASURED = {
    "sparse_error": _POINT_ERRORS,
    "held_out_error": _POINT_ERRORS,
    "scores": _SCORES,
}
_STAGES = ("before", "after")
_EFFECTIVE = ("layer", "iterations", "lr", "step", "loss", "update", "align")


def row_of(
    name: str, inputs: Mapping[str, str], record: Mapping[str, Any], outputs: Mapping[str, str]
) -> dict[str, Any]:
    """What is kept of a refined frame's record, its inputs by part and its outputs by kind.

    Outputs are paths in the output folder.
    """
    return {
        "name": name,
        "status": "diverged" if record["diverged"] else "done",
        "message": record["diverged"],
        "inputs": dict(inputs),
        "outputs": dict(outputs),
        "size": record["size"],
        "points": record["points"],
        "settings": {name: record["settings"][name] for name in _EFFECTIVE},
        "loss": [record["loss"][0], record["loss"][-1]],
        "improved_share": record["improved_share"],
        **{kind: record[kind] for kind in _MEASURED},
        "warnings": [note for note in record["notes"] if note.startswith("warning")],
        "seconds": record["seconds"],
    }


def failed_row(name: str, inputs: Mapping[str, str], message: str) -> dict[str, Any]:
    """The same of a frame that could not be refined."""
    return {
        "name": name,
        "status": "failed",
        "message": message,
        "inputs": dict(inputs),
        "outputs": {},
        **dict.fromkeys(_MEASURED),
    }


class Tally:
    """Counts and means over rows, which are not kept."""

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter({"done": 0, "diverged": 0, "failed": 0})
        self.warned = 0
        self._sums: dict[tuple[str, str, str], tuple[int, float]] = {}

    def add(self, row: Mapping[str, Any]) -> None:
        """One more row."""
        self.counts[row["status"]] += 1
        self.warned += bool(row.get("warnings"))
        for place, value in _measures(row):
            if value is not None:
                count, total = self._sums.get(place, (0, 0.0))
                self._sums[place] = (count + 1, total + value)

    def mean(self) -> dict[str, Any]:
        """{"scores": {"frames": 9, "before": {"rmse": …}, "after": …}, …}; None where no frame."""
        means: dict[str, Any] = {
            kind: {"frames": 0, **{stage: {} for stage in _STAGES}} for kind in _MEASURED
        }
        for (kind, stage, measure), (count, total) in self._sums.items():
            means[kind]["frames"] = max(means[kind]["frames"], count)
            means[kind][stage][measure] = total / count
        return {kind: found if found["frames"] else None for kind, found in means.items()}


def _measures(row: Mapping[str, Any]) -> Iterator[tuple[tuple[str, str, str], float | None]]:
    for kind, measures in _MEASURED.items():
        found = row.get(kind)
        if found:
            for stage in _STAGES:
                for measure in measures:
                    yield (kind, stage, measure), found[stage].get(measure)


def write_summary(path: Path, head: Mapping[str, Any], rows: Iterable[Mapping[str, Any]]) -> None:
    """`path` holds the head as JSON, and the rows as its list `frames`, a line each."""
    text = json.dumps(plain(head), indent=2, ensure_ascii=False, allow_nan=False)
    with atomic_path(path) as temporary, _text_file(temporary) as file:
        file.write(text.removesuffix("\n}") + ',\n  "frames": [')
        for number, row in enumerate(rows):
            line = json.dumps(plain(row), ensure_ascii=False, allow_nan=False)
            file.write(f"{',' if number else ''}\n    {line}")
        file.write("\n  ]\n}\n")


def write_table(path: Path, rows: Iterable[Mapping[str, Any]]) -> None:
    """`path` holds a line for each row as CSV: its status, its errors, its seconds."""
    header = [
        *("name", "status", "message", "points", "held_out_points", "improved_share"),
        *(
            f"{kind}_{measure}_{stage}" if kind != "scores" else f"{measure}_{stage}"
            for kind, measures in _MEASURED.items()
            for stage in _STAGES
            for measure in measures
        ),
        *("warnings", "seconds_read", "seconds_refine", "seconds_write"),
    ]
    with atomic_path(path) as temporary, _text_file(temporary) as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(header)
        for row in rows:
            points, seconds = row.get("points") or {}, row.get("seconds") or {}
            measured = dict(_measures(row))
            writer.writerow(
                [
                    *(text_cell(row["name"]), row["status"], text_cell(row["message"] or "")),
                    *(points.get("used"), points.get("held_out"), row.get("improved_share")),
                    *(
                        measured.get((kind, stage, measure))
                        for kind, measures in _MEASURED.items()
                        for stage in _STAGES
                        for measure in measures
                    ),
                    text_cell("; ".join(row.get("warnings") or ())),
                    *(seconds.get(stage) for stage in ("read", "refine", "write")),
                ]
            )


def _text_file(path: Path) -> Any:
    # A file name that is no UTF-8 has characters that are none; JSON spells them so.
    return path.open("w", encoding="utf-8", errors="backslashreplace", newline="")
