"""Reads saved scores: of `pnpdepth eval --json`, of a batch's summary, of a refinement record."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pnpdepth_cli.choices import MEASURE_GROUPS
from pnpdepth_cli.commands.evaluation.dependence import groups_by_name
from pnpdepth_cli.commands.evaluation.protocols import PROTOCOLS
from pnpdepth_cli.core.metrics import MEASURES, Measure
from pnpdepth_cli.errors import FileFormatError, UsageError
from pnpdepth_cli.io.file_bytes import one_line
from pnpdepth_cli.io.record import read_json

_STAGES = ("before", "after")
_MOST_PIXELS = 1 << 53


@dataclass(frozen=True, kw_only=True)
class RunFrame:
    """The saved scores of one frame."""

    values: dict[str, float]
    """Measures by their key; NaN for null."""
    pixels: int
    """Scored pixels."""
    group: str
    """The sequence the frame belongs to."""
    known: int | None = None
    """Pixels with ground truth; None where the file does not say."""
    sums: tuple[float, ...] = ()
    """Of a pooled run: over the pixels, in the order of core.metrics.SUMS."""


@dataclass(frozen=True, kw_only=True)
class Run:
    """The scored frames of one saved run."""

    label: str
    """The file's name without its folder."""
    path: str
    """As the user gave it."""
    measures: tuple[Measure, ...]
    """Those of all frames."""
    scoring: dict[str, Any]
    """The rules that decide the figures."""
    frames: dict[str, RunFrame]
    """By their name."""

    @property
    def pooled(self) -> bool:
        """True if the mean is over the pixels of all frames."""
        return self.scoring.get("average") == "pooled"


def read_run(text: str) -> Run:
    """Returns the run in a file, or in the summary of a batch's folder.

    Args:
        text: The path; `FILE:before` means the prediction that a refinement started from, without
            it its result is meant.

    Raises:
        FileFormatError: For a file without scores.
        UsageError: For `:before` of an evaluation.
    """
    path, stage = Path(text), "after"
    start, colon, end = text.rpartition(":")
    if colon and end in _STAGES and not path.exists():
        path, stage = Path(start), end
    if path.is_dir():
        path = path / "summary.json"
    record = read_json(path)
    label = f"{path.stem}:before" if stage == "before" else path.stem
    try:
        if record.get("command") != "eval":
            return _refinement_run(text, label, path, record, stage)
        if stage == "before":
            raise UsageError(f"{path} is of eval, which has no before; leave out :before")
        return _eval_run(text, label, record)
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        fact = one_line(repr(error))
        raise FileFormatError(
            f"{path} does not hold scores as pnpdepth writes them ({fact}); create it again"
        ) from error


def _eval_run(text: str, label: str, record: Mapping[str, Any]) -> Run:
    scored = [frame for frame in record["frames"] if frame["error"] is None]
    return Run(
        label=label,
        path=text,
        measures=_measures(record),
        scoring=dict(record["protocol"]["scoring"]),
        frames={
            str(frame["name"]): RunFrame(
                values=_numbers(frame["values"]),
                pixels=_count(frame["pixels"]),
                group=str(frame["group"]),
                known=None if frame["known"] is None else _count(frame["known"]),
                sums=tuple(float(each) for each in frame.get("sums", ())),
            )
            for frame in scored
        },
    )


def _measures(record: Mapping[str, Any]) -> tuple[Measure, ...]:
    """The measures of a record, as its protocol shows them; those unknown here are left out."""
    keys = [each["key"] for each in record["measures"]]
    known = {measure.key: measure for measure in PROTOCOLS[record["protocol"]["name"]].measures}
    if any(key not in known for key in keys):
        groups = MEASURE_GROUPS.values()
        known = {measure.key: measure for group in groups for measure in group.measures} | known
    return tuple(known[key] for key in keys if key in known)


def _count(value: Any) -> int:
    if type(value) is not int or not 0 <= value < _MOST_PIXELS:
        raise ValueError(f"{one_line(value)!r} is no count of pixels")
    return value


def _refinement_run(
    text: str, label: str, path: Path, record: Mapping[str, Any], stage: str
) -> Run:
    """The run in a batch's summary, or of the one frame of a record."""
    if isinstance(record.get("frames"), list):
        scores = {entry["name"]: entry.get("scores") for entry in record["frames"]}
    else:
        scores = {path.stem: record.get("scores")}
    values = {name: _numbers(each[stage]) for name, each in scores.items() if each is not None}
    if not values:
        raise FileFormatError(
            f"{path} holds no scores; give what eval --json printed, or the summary of a batch or"
            " the record of a refinement with ground truth"
        )
    groups = groups_by_name(list(values))
    return Run(
        label=label,
        path=text,
        measures=tuple(m for m in MEASURES if all(m.key in each for each in values.values())),
        scoring=PROTOCOLS["paper"].scoring(),
        frames={
            name: RunFrame(
                values=each,
                pixels=round(each["pixels"]),
                group=group,
                known=round(each["pixels"] / each["coverage"]) if each["coverage"] else None,
            )
            for (name, each), group in zip(values.items(), groups, strict=True)
        },
    )


def _numbers(values: Mapping[str, Any]) -> dict[str, float]:
    return {key: math.nan if value is None else float(value) for key, value in values.items()}
