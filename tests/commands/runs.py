"""Saved runs of frames with given scores, for the tests of comparisons."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from pnpdepth_cli.commands.compare import compare
from pnpdepth_cli.commands.comparisons.comparison import Comparison
from pnpdepth_cli.dataset.frame_record import FrameRecord, Scores
from pnpdepth_cli.io.file_bytes import write_json


def saved(folder: Path, *frames: dict[str, Scores], groups: str = "", **summary: object) -> str:
    """The saved summary of frames with these scores of each stage, and of one that failed."""
    records = [
        FrameRecord(name=f"{n}", group=groups[n : n + 1] or None, errors={"ground_truth": stages})
        for n, stages in enumerate(frames)
    ]
    records.append(FrameRecord(name="spoilt", status="failed"))
    folder.mkdir()
    path = folder / "summary.json"
    write_json(path, {"frames": [record.to_json() for record in records], **summary})
    return str(path)


def run(folder: Path, errors: Iterable[float]) -> str:
    """A saved run of frames with these errors."""
    scores: list[Scores] = [{"rmse": error, "mae": error, "delta1": 1.0} for error in errors]
    return saved(folder, *({"after": of_frame} for of_frame in scores))


def refined(folder: Path, mae: float, **varied: str) -> str:
    """A batch of one frame whose MAE was 1 m before refinement."""
    stages: dict[str, Scores] = {"before": {"mae": 1.0}, "after": {"mae": mae}}
    return saved(folder / ",".join(varied.values()), stages, varied=varied)


def compared_by_factors(folder: Path, frames: int) -> tuple[Comparison, float, float]:
    """Two runs of which the second is better on every frame, and their mean errors."""
    errors, factors = np.random.default_rng(0).uniform(0.5, 0.9, (2, frames))
    better = errors * factors
    comparison = compare([run(folder / "one", errors), run(folder / "two", better)])
    return comparison, errors.mean(), better.mean()
