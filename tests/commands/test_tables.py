"""Tables of errors and of compared runs, cell by cell, from the numbers they show."""

from __future__ import annotations

from dataclasses import replace
from math import nan
from typing import Any, Literal

import numpy as np
import pytest

from pnpdepth_cli.commands.error_tables import (
    baselines_table,
    change,
    names_of_depths,
    refinement_table,
)
from pnpdepth_cli.commands.evaluation.compare import (
    ComparedRun,
    Comparison,
    Gain,
    comparison_table,
    methods_table,
)
from pnpdepth_cli.commands.statistics import find_clusters
from pnpdepth_cli.commands.tables import Table
from pnpdepth_cli.dataset.frame_record import FrameRecord, MethodRecord, ModelRecord, Scores
from pnpdepth_cli.measures import MEASURES


@pytest.mark.parametrize(
    ("key", "before", "after", "text", "style"),
    [
        ("mae", None, 1.0, "–", "dim"),
        ("mae", 1.0, nan, "–", "dim"),
        ("mae", 0.0, 1.0, "–", "dim"),
        ("mae", 2, 2, "+0.0%", "dim"),
        ("mae", 1.0, 0.5, "-50.0%", "good"),
        ("delta1", 0.0, 0.25, "+25.00 pt", "good"),
        ("delta1", 0.75, 0.5, "-25.00 pt", "bad"),
    ],
)
def test_a_change_is_relative_or_in_points_and_coloured_by_whether_it_is_better(
    key: str, before: float | None, after: float | None, text: str, style: str
) -> None:
    cell = change(key, before, after)
    assert (cell, cell.style) == (text, style)


def record_of(
    *networks: str, weights: dict[str, float] | None = None, **fields: Any
) -> FrameRecord:
    """A record of "net", refined by the default method if networks are named."""
    kind: Literal["default", "fixed"] = "default" if networks else "fixed"
    return FrameRecord(
        model=ModelRecord(name="net", spec="net", checkpoint=None, checkpoint_sha256=None),
        method=MethodRecord(kind=kind, reason="", networks=[*networks] or ["net"]),
        weights=weights or {},
        **fields,
    )


def at_points(count: int, **maes: float | None) -> dict[str, Scores]:
    """The MAE of each stage at as many points."""
    return {stage: {"mae": mae, "points": count} for stage, mae in maes.items()}


def test_stages_stand_against_linear_interpolation_and_the_last_is_bold() -> None:
    at = at_points(12, before=4.0, propagated=1.0, after=1.0, linear=2.0)
    record = record_of("net", weights={"net": 1.0}, errors={"validation": at})
    assert styled(refinement_table(record)) == [
        [("net, aligned with the points", ""), ("4.0000 m", ""), ("+100.0%", "bad")],
        [("net, residual propagated", "bold"), ("1.0000 m", "bold"), ("-50.0%", "good")],
        [("linear interpolation of all points", ""), ("2.0000 m", ""), ("", "")],
    ]
    at |= at_points(12, alone=0.7, after=0.5)
    weights = {"net": 0.15, "other with net": 0.0, "other": 0.85}
    record = record_of("net", "other", weights=weights, errors={"validation": at})
    *_, alone, result, _ = (row[0] for row in refinement_table(record).rows)
    assert (alone, result) == ("other alone", "fused (net 15%, other 85%)")


def test_errors_stand_by_what_they_are_measured_on_and_validation_points_count_only_alone() -> None:
    after: Scores = {"rmse": 1.0, "delta1": 0.75, "pixels": 1200, "coverage": 0.5}
    linear: Scores = {"rmse": 4.0, "delta1": 0.75}
    errors = {
        "ground_truth": {"before": {"rmse": 2.0, "delta1": 0.5}, "after": after, "linear": linear},
        "held_out": at_points(1000, before=0.5, after=1.0),
        "validation": at_points(12, before=4.0, after=1.0, linear=2.0),
        "used": at_points(2000, before=0.5, after=0.25),
    }
    record = record_of(settings={"layer": "middle"}, errors=errors)
    table = refinement_table(record)
    scored = "scored on 1,200 pixels of ground truth (50.0% of those known)"
    assert table.title == f"net cut at middle; {scored}"
    at_used = ["error at 2,000 points used, MAE", "0.5000 m", "0.2500 m", "", "", ""]
    assert table.rows == [
        ["RMSE", "2.0000 m", "1.0000 m", "-50.0%", "4.0000 m", "-75.0%"],
        ["δ1", "50.00%", "75.00%", "+25.00 pt", "75.00%", "+0.00 pt"],
        ["error at 1,000 held-out points, MAE", "0.5000 m", "1.0000 m", "+100.0%", "–", "–"],
        at_used,
    ]
    without = {basis: errors[basis] for basis in ("validation", "used")}
    table = refinement_table(replace(record, errors=without))
    assert table.title == "net cut at middle"
    validated = ["error at 12 validation points, MAE", "4.0000 m", "1.0000 m", "-75.0%"]
    assert table.rows == [[*validated, "2.0000 m", "-50.0%"], at_used]


def test_baselines_are_sorted_and_have_ground_truth_where_one_of_them_has() -> None:
    errors: dict[str, dict[str, Scores]] = {
        "ground_truth": {"nearest": {"mae": 3.0, "rmse": 4.0}},
        "validation": at_points(12, nearest=2.0, after=1.0, linear=None),
    }
    table = baselines_table(errors, "m")
    columns = ["MAE, validation points", "MAE, ground truth", "RMSE, ground truth"]
    assert table.columns == ["", *columns]
    assert styled(table) == [
        [("result", "bold"), ("1.0000 m", "bold"), ("–", "bold"), ("–", "bold")],
        [("nearest", ""), ("2.0000 m", ""), ("3.0000 m", ""), ("4.0000 m", "")],
    ]
    unknown = {"validation": at_points(12, nearest=None, linear=None)}
    assert sorted(baselines_table(unknown, "m").rows) == [["linear", "–"], ["nearest", "–"]]


def styled(table: Table) -> list[list[tuple[str, str]]]:
    return [[(cell, getattr(cell, "style", "")) for cell in row] for row in table.rows]


def test_the_best_of_a_column_is_bold_and_stars_and_colours_are_the_p_values() -> None:
    def gain(percent: float, p: float) -> Gain:
        return Gain(
            percent=percent, low_percent=nan, high_percent=1.0, difference=nan, p_value=nan,
            p_adjusted=p,
        )  # fmt: skip

    gains: list[dict[str, Gain]] = [
        {},
        {"rmse": gain(50.0, 0.0009), "delta1": gain(-50.0, 0.01)},
        {"rmse": gain(-50.0, 0.049), "delta1": gain(nan, nan)},
    ]
    means = [(2.0, 0.5), (1.0, 0.25), (3.0, None)]
    runs = [
        ComparedRun(
            name=name, path=name, mean={"rmse": rmse, "delta1": delta},
            before={}, varied={}, coverage=1.0, gains=of_first,
        )
        for name, (rmse, delta), of_first in zip("abc", means, gains, strict=True)
    ]  # fmt: skip
    comparison = Comparison(
        frames=("1", "2"),
        measures=tuple(measure for measure in MEASURES if measure.key in ("rmse", "delta1")),
        scoring={"exclude_sparse": True},
        runs=tuple(runs),
        clusters=find_clusters(["1", "2"], np.zeros((2, 1))),
        exact_p_values=False,
        tests=4,
        notes=[],
    )
    assert styled(methods_table(comparison)) == [
        [("a", ""), ("2.0000", ""), ("50.00%", "bold")],
        [("b", ""), ("1.0000***", "bold"), ("25.00%*", "")],
        [("c", ""), ("3.0000*", ""), ("–", "")],
    ]
    shown = [row[3] for row in styled(comparison_table(comparison))]
    plain, better, worse = ("–", ""), ("+50.00", "good"), ("-50.00", "bad")
    assert shown == [plain, better, worse, plain, worse, ("–", "dim")]
    assert comparison_table(comparison).rows[1][4:] == ["–", "+1.00", "0.0009"]
    assert "from 10,000 random swaps, over 2 frames" in comparison_table(comparison).title
    for table in (comparison_table(comparison), methods_table(comparison)):
        assert table.title.endswith("; without the pixels of sparse points")


@pytest.mark.parametrize(
    ("weights", "after"),
    [
        ({"net": 1.0}, "net, residual propagated"),
        ({"net": 0.0, "compact": 1.0}, "fused (compact 100%)"),
        ({"net": 0.25, "compact": 0.75}, "fused (net 25%, compact 75%)"),
    ],
)
def test_the_depth_of_a_picture_is_of_the_networks_that_have_a_part(
    weights: dict[str, float], after: str
) -> None:
    record = record_of("net", "compact", weights=weights)
    assert names_of_depths(record) == ("net, aligned with the points", after)
