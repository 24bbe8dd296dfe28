"""Writes the results of a batch, `summary.json` and `summary.csv`, frame by frame."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from pnpdepth_cli.io.atomic import atomic_path
from pnpdepth_cli.io.csv_text import write_csv
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
_CHECKED = {"before": "aligned", "after": "result", "linear": "linear"}
BASELINE_MEASURES = ("held_out_mae", "mae", "rmse")
_EFFECTIVE = ("layer", "iterations", "lr", "step", "loss", "update", "align")


def row_of(
    name: str, inputs: Mapping[str, str], record: Mapping[str, Any], outputs: Mapping[str, str]
) -> dict[str, Any]:
    """Returns the summary's row of a refined frame.

    Args:
        name: The frame's name.
        inputs: Its files by part.
        record: The refinement's record.
        outputs: Its results by kind, as paths in the output folder.
    """
    return {
        "name": name,
        "status": "diverged" if record["diverged"] else "done",
        "message": record["diverged"],
        "inputs": dict(inputs),
        "outputs": dict(outputs),
        "size": record["size"],
        "unit": record["unit"],
        "points": record["points"],
        "settings": {name: record["settings"][name] for name in _EFFECTIVE},
        "loss": [record["loss"][0], record["loss"][-1]],
        "improved_fraction": record["improved_fraction"],
        **{kind: record[kind] for kind in _MEASURED},
        "linear": record.get("linear"),
        "baselines": record.get("baselines"),
        "warnings": [note for note in record["notes"] if note.startswith("warning")],
        "seconds": record["seconds"],
    }


def failed_row(name: str, inputs: Mapping[str, str], message: str) -> dict[str, Any]:
    """Returns the summary's row of a frame that could not be refined."""
    return {
        "name": name,
        "status": "failed",
        "message": message,
        "inputs": dict(inputs),
        "outputs": {},
        **dict.fromkeys(_MEASURED),
        "linear": None,
        "baselines": None,
    }


class Tally:
    """Counts rows and adds up their scores; the rows are not kept."""

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter({"done": 0, "diverged": 0, "failed": 0})
        self.warned = 0
        self._units: set[str] = set()
        self._compared, self._worse = 0, 0
        self._linear: dict[tuple[str, str], tuple[int, float]] = {}
        self._checks: dict[str, tuple[int, float]] = {}
        self._sums: dict[tuple[str, str, str], tuple[int, float]] = {}
        self._baselines: dict[tuple[str, str], tuple[int, float]] = {}

    def add(self, row: Mapping[str, Any]) -> None:
        """Adds one row."""
        self.counts[row["status"]] += 1
        self.warned += bool(row.get("warnings"))
        self._units |= {row["unit"]} if "unit" in row else set()
        for key, value in _measures(row):
            _add(self._sums, key, value)
        linear = row.get("linear") or {}
        if linear.get("worse") is not None:
            self._compared += 1
            self._worse += linear["worse"]
        for kind in ("scores", "held_out_error"):
            for measure in _MEASURED[kind]:
                _add(self._linear, (kind, measure), (linear.get(kind) or {}).get(measure))
        if linear.get("worse") is not None and linear.get("check"):
            for stage, name in _CHECKED.items():
                _add(self._checks, stage, linear["check"][name])
        for name, entry in (row.get("baselines") or {}).items():
            for measure, value in _baseline_measures(entry).items():
                _add(self._baselines, (name, measure), value)

    @property
    def unit(self) -> str:
        """The unit of all depths."""
        return " and ".join(sorted(self._units)) or "m"

    @property
    def baseline_names(self) -> list[str]:
        """The baselines of any row, in the order of the records."""
        return list(dict.fromkeys(name for name, _ in self._baselines))

    def mean(self) -> dict[str, Any]:
        """Returns {"scores": {"frames": 9, "before": {"rmse": …}, …}, …}; None without frames."""
        means: dict[str, Any] = {
            kind: {"frames": 0, **{stage: {} for stage in _STAGES}} for kind in _MEASURED
        }
        for (kind, stage, measure), (count, total) in self._sums.items():
            means[kind]["frames"] = max(means[kind]["frames"], count)
            means[kind][stage][measure] = total / count if count else None
        return {kind: mean if mean["frames"] else None for kind, mean in means.items()}

    def mean_linear(self) -> dict[str, Any]:
        """Returns the means of linear interpolation's scores, and how many frames are worse.

        "check" has the mean errors of all three at the hidden points.
        """
        means: dict[str, Any] = {
            kind: {
                measure: total / count if count else None
                for (of, measure), (count, total) in self._linear.items()
                if of == kind
            }
            for kind in ("scores", "held_out_error")
        }
        check = {stage: total / count for stage, (count, total) in self._checks.items() if count}
        if check:
            check["frames"] = max(count for count, _ in self._checks.values())
        return means | {
            "check": check or None,
            "frames": self._compared,
            "worse": self._worse,
        }

    def mean_baselines(self) -> dict[str, dict[str, Any]] | None:
        """Returns {"linear": {"frames": 9, "held_out_mae": …, "mae": …, "rmse": …}, …}."""
        means: dict[str, dict[str, Any]] = {
            name: {"frames": 0, **dict.fromkeys(BASELINE_MEASURES)} for name in self.baseline_names
        }
        for (name, measure), (count, total) in self._baselines.items():
            means[name]["frames"] = max(means[name]["frames"], count)
            means[name][measure] = total / count if count else None
        return means or None


def _measures(row: Mapping[str, Any]) -> Iterator[tuple[tuple[str, str, str], float | None]]:
    for kind, measures in _MEASURED.items():
        scores = row.get(kind)
        if scores:
            for stage in _STAGES:
                for measure in measures:
                    yield (kind, stage, measure), (scores[stage] or {}).get(measure)


def _baseline_measures(entry: Mapping[str, Any]) -> dict[str, float | None]:
    scores = entry.get("scores") or {}
    measured = {"held_out_mae": entry.get("held_out_mae")}
    return measured | {measure: scores.get(measure) for measure in ("mae", "rmse")}


def _add(sums: dict[Any, tuple[int, float]], key: Any, value: float | None) -> None:
    """Adds a value to a count and a sum; one that is None or NaN makes only the entry."""
    count, total = sums.setdefault(key, (0, 0.0))
    if value is not None and not math.isnan(value):
        sums[key] = (count + 1, total + value)


def profile_of(seconds: Mapping[str, float], frames: int, wall_s: float) -> dict[str, Any]:
    """Returns where the time of a run went: {"frames": 24, "seconds": {"read": …, "wall": …}, …}.

    Reading and writing run beside the network, so their seconds do not add up to the wall time.

    Args:
        seconds: Of all refined frames, by stage.
        frames: Their number.
        wall_s: From the first frame's start to the end of the last.
    """
    stages = {stage: round(seconds.get(stage, 0.0), 4) for stage in ("read", "refine", "write")}
    return {
        "frames": frames,
        "seconds": stages | {"wall": round(wall_s, 4)},
        "frames_per_second": round(frames / wall_s, 4),
        "network_busy": round(stages["refine"] / wall_s, 4),
    }


def write_summaries(
    folder: Path,
    head: Mapping[str, Any],
    rows: Iterable[Mapping[str, Any]],
    baselines: Sequence[str],
) -> None:
    """Writes `summary.json`, the head with the rows as its list `frames`, and `summary.csv`.

    Args:
        folder: Where they are written.
        head: The summary without its frames.
        rows: The rows, of JSON's own types.
        baselines: Names of baselines, whose errors make the last columns of the table.
    """
    header = [
        *("name", "status", "message", "points", "held_out_points", "improved_fraction"),
        *(
            f"{kind}_{measure}_{stage}" if kind != "scores" else f"{measure}_{stage}"
            for kind, measures in _MEASURED.items()
            for stage in _STAGES
            for measure in measures
        ),
        *("warnings", "seconds_read", "seconds_refine", "seconds_write"),
        *(f"baseline_{name}_{measure}" for name in baselines for measure in BASELINE_MEASURES),
    ]
    text = json.dumps(plain(head), indent=2, ensure_ascii=False, allow_nan=False)
    with (
        atomic_path(folder / JSON) as json_path,
        atomic_path(folder / CSV) as csv_path,
        _text_file(json_path) as file,
        _text_file(csv_path) as table,
    ):
        file.write(text.removesuffix("\n}") + ',\n  "frames": [')

        def table_rows() -> Iterator[list[Any]]:
            for number, row in enumerate(rows):
                line = json.dumps(row, ensure_ascii=False, allow_nan=False)
                file.write(f"{',' if number else ''}\n    {line}")
                yield _table_row(row, baselines)

        write_csv(table, header, table_rows())
        file.write("\n  ]\n}\n")


def _table_row(row: Mapping[str, Any], baselines: Sequence[str]) -> list[Any]:
    points, seconds = row.get("points") or {}, row.get("seconds") or {}
    measured = dict(_measures(row))
    of_baselines = {
        name: _baseline_measures(entry) for name, entry in (row.get("baselines") or {}).items()
    }
    return [
        *(row["name"], row["status"], row["message"] or ""),
        *(points.get("used"), points.get("held_out"), row.get("improved_fraction")),
        *(
            measured.get((kind, stage, measure))
            for kind, measures in _MEASURED.items()
            for stage in _STAGES
            for measure in measures
        ),
        "; ".join(row.get("warnings") or ()),
        *(seconds.get(stage) for stage in ("read", "refine", "write")),
        *(
            of_baselines.get(name, {}).get(measure)
            for name in baselines
            for measure in BASELINE_MEASURES
        ),
    ]


def _text_file(path: Path) -> Any:
    # a file name that is no UTF-8 has surrogates; JSON escapes them so
    return path.open("w", encoding="utf-8", errors="backslashreplace", newline="")
