"""Means over the draws of a sweep's points."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from pnpdepth_cli.pipeline.sweep.tables import over_seeds


def cell(seed: int, value: float | None, **others: str) -> dict[str, Any]:
    mae = dict.fromkeys(("plain", "linear", "refined", "gain"), value)
    return {"parameters": {**others, "seed": str(seed)}, "measures": {"mae": mae}}


def test_the_interval_is_students_over_the_draws() -> None:
    # scipy.stats.t.ppf(0.975, 3) = 3.182446305 (any table of Student's t)
    values = np.array([1.0, 2.0, 4.0, 5.0])
    (summary,) = over_seeds([cell(n, float(value)) for n, value in enumerate(values)])
    half = 3.182446305 * values.std(ddof=1) / 2.0
    assert summary["seeds"] == 4
    assert summary["mae"]["refined"] == pytest.approx(
        {"mean": 3.0, "low": 3.0 - half, "high": 3.0 + half}
    )


def test_the_intervals_cover_the_mean_of_normal_draws_as_often_as_stated() -> None:
    rng = np.random.default_rng(0)
    covered = 0
    for _ in range(400):
        (summary,) = over_seeds([cell(n, float(v)) for n, v in enumerate(rng.normal(0, 1, 5))])
        covered += summary["mae"]["gain"]["low"] < 0 < summary["mae"]["gain"]["high"]
    assert 0.92 < covered / 400 < 0.98


def test_each_setting_of_the_other_parameters_has_its_own_row() -> None:
    cells = [cell(n, k + n, points=str(k)) for k in (20, 100) for n in range(3)]
    assert [(row["parameters"], row["mae"]["plain"]["mean"]) for row in over_seeds(cells)] == [
        ({"points": "20"}, 21.0),
        ({"points": "100"}, 101.0),
    ]


def test_two_seeds_and_cells_without_scores_give_no_interval() -> None:
    assert over_seeds([cell(0, 1.0), cell(1, 2.0)]) == []
    failed: dict[str, Any] = {"parameters": {"seed": "2"}, "measures": None}
    assert over_seeds([cell(0, 1.0), cell(1, 2.0), failed]) == []
    (summary,) = over_seeds([cell(0, 1.0), cell(1, 2.0), cell(2, None)])
    assert summary["mae"]["refined"] == {"mean": None, "low": None, "high": None}
