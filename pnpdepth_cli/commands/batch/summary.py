"""Writes the results of a batch, `summary.json` and `summary.csv`, frame by frame."""

from __future__ import annotations

import json
import re
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np

from pnpdepth_cli.commands.statistics import find_clusters
from pnpdepth_cli.dataset.frame_files import groups_by_name
from pnpdepth_cli.io.atomic import atomic_path
from pnpdepth_cli.io.csv_text import write_csv
from pnpdepth_cli.io.record import plain
from pnpdepth_cli.measures import MEASURES, FrameMeans

Row = dict[str, Any]
# a file name that is no UTF-8 has surrogates; JSON escapes them so
TEXT: Any = {"encoding": "utf-8", "errors": "backslashreplace", "newline": "\n"}
CSV, JSON = "summary.csv", "summary.json"

_POINT_ERRORS = ("mae", "rmse")
_SCORES = (*(measure.key for measure in MEASURES), "coverage")
_MEASURED = {
    "sparse_error": _POINT_ERRORS,
    "held_out_error": _POINT_ERRORS,
    "scores": _SCORES,
}
_MAIN = tuple(measure.key for measure in MEASURES if measure.main)
_OF_LINEAR = ("scores", "held_out_error")
_BASELINE = "baseline"
_RUN_STAGES = ("read", "refine", "write")
_CHECKED = ("aligned", "result", "linear")
"""Stages whose errors at validation points are averaged."""
_NUMBER = re.compile(r"\d[\d.,]*")
_NAMED = 3
"""Names of frames that are listed with a warning."""
_EFFECTIVE = ("layer", "iterations", "lr", "step", "loss", "update", "align")


def row_of(
    name: str, inputs: Mapping[str, str], record: Mapping[str, Any], outputs: Mapping[str, str]
) -> dict[str, Any]:
    """Returns the summary's row of a refined frame, from its files and record."""
    unsure = [note for note in record["notes"] if ", unsure (" in note]
    return {
        "name": name,
        "status": "diverged" if record["diverged"] else "done",
        "message": record["diverged"],
        "inputs": dict(inputs),
        "outputs": dict(outputs),
        "size": record["size"],
        "unit": record["unit"],
        "points": {**record["points"]},  # a damaged record raises here
        "settings": {name: record["settings"][name] for name in _EFFECTIVE},
        "loss": [record["loss"][0], record["loss"][-1]],
        "improved_fraction": record["improved_fraction"],
        **{kind: record[kind] for kind in _MEASURED},
        "weights": record["weights"],
        "linear": record.get("linear"),
        "baselines": record.get("baselines"),
        "warnings": [note for note in record["notes"] if note.startswith("warning")],
        "seconds": {**record["seconds"]},
        **({"unsure": unsure} if unsure else {}),
    }


def failed_row(name: str, inputs: Mapping[str, str], message: str) -> dict[str, Any]:
    """Returns the summary's row of a frame that could not be refined."""
    return {
        "name": name,
        "status": "failed",
        "message": message,
        "inputs": dict(inputs),
        "outputs": {},
        **dict.fromkeys((*_MEASURED, "weights", "linear", "baselines")),
    }


class Warned(NamedTuple):
    """The frames with one kind of warning."""

    note: str
    """The warning of the first frame."""
    names: list[str]


class Tally:
    """Counts rows and adds up their scores; the rows are not kept."""

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter({"done": 0, "diverged": 0, "failed": 0})
        self.warned = 0
        self._warnings: dict[str, Warned] = {}  # by the text without its numbers
        self.unsure: dict[str, None] = {}
        """What was guessed of the network and may be wrong, each once."""
        self._units: set[str] = set()
        self._compared, self._worse = 0, 0
        self._weights: defaultdict[str, list[float]] = defaultdict(list)
        # names, groups and main errors of the frames with ground truth
        self._names: list[str] = []
        self._groups: list[str | None] = []
        self._scores: list[list[float | None]] = []
        # by kind and stage
        self._errors: defaultdict[tuple[str, str], FrameMeans] = defaultdict(FrameMeans)

    def add(self, row: Row) -> None:
        """Adds one row."""
        self.counts[row["status"]] += 1
        warnings = row.get("warnings") or ()
        self.warned += bool(warnings)
        for note in warnings:
            kind = _NUMBER.sub("", note)
            self._warnings.setdefault(kind, Warned(note=note, names=[])).names.append(row["name"])
        self.unsure |= dict.fromkeys(row.get("unsure", ()))
        self._units |= {row["unit"]} if "unit" in row else set()
        for key, values in _measured(row).items():
            self._errors[key].add(values)
        for name, weight in (row.get("weights") or {}).items():
            self._weights[name].append(weight)
        if row["scores"]:
            self._names.append(row["name"])
            self._groups.append(row.get("group"))
            self._scores.append([row["scores"]["after"].get(key) for key in _MAIN])
        worse = (row.get("linear") or {}).get("worse")
        self._compared += worse is not None
        self._worse += bool(worse)

    @property
    def warnings(self) -> list[dict[str, Any]]:
        """The kinds of warnings: frames, the first names, and the note of the first."""
        return [
            {"frames": len(each.names), "first": each.names[:_NAMED], "note": each.note}
            for each in self._warnings.values()
        ]

    @property
    def unit(self) -> str:
        """The unit of all depths."""
        return " and ".join(sorted(self._units)) or "m"

    def notes(self) -> list[str]:
        """Returns how many of the frames with ground truth count as independent."""
        by_name = groups_by_name(self._names)
        groups = [own or name for own, name in zip(self._groups, by_name, strict=True)]
        if len(groups) < 2:
            return []
        clusters = find_clusters(groups, np.array(self._scores, np.float64))
        return clusters.notes()

    @property
    def baselines(self) -> list[str]:
        """Names of the baselines, in the order of the records."""
        return [name for kind, name in self._errors if kind == _BASELINE]

    def means(self) -> dict[str, Any]:
        """Returns the means of the results, of linear interpolation and of the baselines.

        "mean" has {"scores": {"frames": 9, "before": {"rmse": …}, …}, …}, or None without frames;
        "linear" also how many frames are worse, and the errors of all at the validation points.
        "weights" has the mean and the range of each expert's. A mean is over the frames that have
        the value; None where none has it.
        """
        mean: dict[str, Any] = {}
        for kind in _MEASURED:
            before, after = (self._errors[kind, stage] for stage in ("before", "after"))
            frames = max(before.frames, after.frames)
            both = {"frames": frames, "before": before.means(), "after": after.means()}
            mean[kind] = both if frames else None
        checked = self._errors["validation", ""]
        linear = {
            **{kind: self._errors[kind, "linear"].means() for kind in _OF_LINEAR},
            "validation": checked.means() | {"frames": checked.frames} if checked.frames else None,
            "frames": self._compared,
            "worse": self._worse,
        }
        of_names = {name: self._errors[_BASELINE, name] for name in self.baselines}
        baselines = {
            name: {"frames": errors.frames, **errors.means()} for name, errors in of_names.items()
        }
        return {
            "mean": mean,
            "linear": linear,
            "weights": self.weights or None,
            "baselines": baselines or None,
        }

    @property
    def weights(self) -> dict[str, dict[str, float]]:
        """Mean, least and largest weight of each expert of the default method, by name."""
        return {
            name: {"mean": sum(all_) / len(all_), "least": min(all_), "largest": max(all_)}
            for name, all_ in self._weights.items()
        }


def _measured(row: Row) -> dict[tuple[str, str], dict[str, float | None]]:
    """The errors of a row by kind and stage, or by name of the baseline."""
    linear = row.get("linear") or {}
    errors = {
        (kind, stage): row[kind][stage]
        for kind in _MEASURED
        if row.get(kind)
        for stage in ("before", "after")
    }
    errors |= {(kind, "linear"): linear.get(kind) for kind in _OF_LINEAR}
    found = {
        key: {name: (values or {}).get(name) for name in _MEASURED[key[0]]}
        for key, values in errors.items()
    }
    if check := linear.get("validation"):
        found["validation", ""] = {name: check[name] for name in _CHECKED}
    for name, entry in (row.get("baselines") or {}).items():
        scores = entry.get("scores") or {}
        of_truth = {measure: scores.get(measure) for measure in _POINT_ERRORS}
        found[_BASELINE, name] = {"validation_mae": entry.get("validation_mae"), **of_truth}
    return found


def write_summaries(
    folder: Path, head: Mapping[str, Any], rows: IO[str], baselines: Sequence[str]
) -> None:
    """Writes `summary.json`, the head with the rows as its list `frames`, and `summary.csv`.

    Args:
        folder: Where they are written.
        head: The summary without its frames.
        rows: A file opened as TEXT, with a row in each line as JSON.
        baselines: Names of the baselines, whose errors make the last columns of the table.
    """
    text = json.dumps(plain(head), indent=2, ensure_ascii=False, allow_nan=False)
    with atomic_path(folder / JSON) as path, path.open("w", **TEXT) as file:
        file.write(text.removesuffix("\n}") + ',\n  "frames": [')
        rows.seek(0)
        for number, line in enumerate(rows):
            file.write(f"{',' if number else ''}\n    {line.removesuffix(chr(10))}")
        file.write("\n  ]\n}\n")
    with atomic_path(folder / CSV) as path, path.open("w", **TEXT) as file:
        header = list(_columns(failed_row("", {}, ""), baselines, head["columns"]))
        rows.seek(0)
        cells = (_columns(json.loads(row), baselines, head["columns"]).values() for row in rows)
        write_csv(file, header, map(list, cells))


def _columns(row: Row, baselines: Sequence[str], keys: Sequence[str] | None) -> dict[str, Any]:
    """The cells of a row by the name of their column; None where a row has no value."""
    points, seconds, measured = row.get("points") or {}, row.get("seconds") or {}, _measured(row)
    cells = {
        "name": row["name"],
        "status": row["status"],
        "message": row["message"] or "",
        "points": points.get("used"),
        "held_out_points": points.get("held_out"),
        "improved_fraction": row.get("improved_fraction"),
    }
    for kind, measures in _MEASURED.items():
        start = "" if kind == "scores" else f"{kind}_"
        shown = measures if keys is None else [k for k in (*keys, "coverage") if k in measures]
        for stage in ("before", "after"):
            values = measured.get((kind, stage), {})
            cells |= {f"{start}{name}_{stage}": values.get(name) for name in shown}
    cells["warnings"] = "; ".join(row.get("warnings") or ())
    cells |= {f"seconds_{stage}": seconds.get(stage) for stage in _RUN_STAGES}
    for name in baselines:
        values = measured.get((_BASELINE, name), {})
        keys = ("validation_mae", *_POINT_ERRORS)
        cells |= {f"baseline_{name}_{key}": values.get(key) for key in keys}
    return cells
