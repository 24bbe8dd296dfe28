"""Tables of errors, cell by cell, from the numbers they show."""

from __future__ import annotations

from dataclasses import replace
from math import nan
from typing import Any

from pnpdepth_cli.commands.shared import tables
from pnpdepth_cli.commands.shared.tables import Table, refinement_tables
from pnpdepth_cli.dataset.frame_record import FrameRecord, Scores
from pnpdepth_cli.measures import MEASURES
from tests.builders import method_record, result_record

ALIGNED = {"kind": "affine"}


def test_a_change_is_relative_and_coloured_by_whether_it_is_better() -> None:
    for before, after, *cell in (
        (1.0, nan, "–", "dim"),
        (0.0, 1.0, "–", "dim"),
        (2.0, 2.0, "+0.0%", "dim"),
        (1.0, 0.5, "-50.0%", "good"),
        (1.0, 1.5, "+50.0%", "bad"),
    ):
        assert [*tables.change_cell(before, after)] == cell


def record_of(errors: dict[str, dict[str, Scores]], *networks: str, **fields: Any) -> FrameRecord:
    """A record of these networks, fused and aligned, with these errors."""
    return FrameRecord(errors=errors, result=result_record(*networks, alignment=ALIGNED, **fields))


def at_points(count: int, **maes: float | None) -> dict[str, Scores]:
    """The MAE of each stage at as many points."""
    return {stage: {"mae": mae, "points": count} for stage, mae in maes.items()}


def texts(table: Table) -> list[list[str]]:
    return [[text for text, _ in row] for row in table.cells]


def test_stages_stand_against_linear_interpolation_and_the_last_is_bold() -> None:
    at = at_points(12, before=4.0, propagated=1.0, after=1.0, linear=2.0)
    record = record_of({"validation": at}, "net", weights={"net": 1.0})
    (table,) = refinement_tables(record)
    assert table.cells == [
        [("net, aligned with the points", ""), ("4.0000 m", ""), ("+100.0%", "bad")],
        [("net, residual propagated", "bold"), ("1.0000 m", "bold"), ("-50.0%", "good")],
        [("linear interpolation of all points", ""), ("2.0000 m", ""), ("", "")],
    ]
    at |= at_points(12, alone=0.7, after=0.5)
    weights = {"net": 0.15, "other with net": 0.0, "other": 0.85}
    record = record_of({"validation": at}, "net", "other", weights=weights)
    *_, alone, result, _ = (row[0] for row in texts(refinement_tables(record)[0]))
    assert (alone, result) == ("other alone", "fused (net 15%, other 85%)")


def test_errors_are_shown_where_they_are_measured_and_at_other_points_only_without() -> None:
    after: Scores = {"rmse": 1.0, "delta1": 0.75, "pixels": 1200, "coverage": 0.5}
    errors = {
        "ground_truth": {"before": {"rmse": 2.0, "delta1": 0.5}, "after": after},
        "held_out": at_points(1000, before=0.5, after=1.0),
        "validation": at_points(12, before=4.0, after=1.0, linear=2.0),
        "used": at_points(2000, before=0.5, after=0.25),
    }
    result = result_record(
        "net",
        method=method_record("net", name="paper", propagation="none"),
        weights={"net": 1.0},
        loss=[1.0] * 4,  # it diverged after 3
    )
    record = FrameRecord(errors=errors, result=result)
    truth, held_out = refinement_tables(record)
    pixels = "errors against ground truth, 1,200 pixels (50.0% of those known)"
    assert truth.title == f"net, method paper: {pixels}"
    assert texts(truth) == [
        ["net", "2.0000 m", "50.00%", "–"],
        ["net, 3 updates of z", "1.0000 m", "75.00%", "–"],
    ]
    assert held_out.title.endswith("errors at held-out points, 1,000 points")
    for basis, count in (("validation", 12), ("used", 2000)):
        (table,) = refinement_tables(replace(record, errors={basis: errors[basis]}))
        assert table.title.endswith(f"{count:,} points")


def test_a_batch_has_its_means_and_every_baseline() -> None:
    stages: dict[str, Scores] = {
        "before": {"mae": 2.0, "rmse": 3.0, "frames": 3},
        "after": {"mae": 1.0, "rmse": None, "frames": 3},
        "linear": {"mae": None, "frames": 3},
        "nearest": {"mae": 3.0, "rmse": 4.0, "frames": 3},
    }
    errors = {"ground_truth": stages, "used": stages}
    titles = tables.stage_titles(result_record("net", alignment=ALIGNED, weights={"net": 1.0}))
    (table,) = tables.means_tables(errors, "m", titles, ("mae", "rmse"))
    assert table.title == "means: errors against ground truth, 3 frames"
    assert table.columns == ["", "MAE", "RMSE", "MAE vs linear"]
    assert [row[:3] for row in texts(table)] == [
        ["net, aligned with the points", "2.0000 m", "3.0000 m"],
        ["net, residual propagated", "1.0000 m", "–"],
        ["linear interpolation of all points", "–", "–"],
        ["nearest", "3.0000 m", "4.0000 m"],
    ]
    assert tables.means_tables({}, "m", {}) == []


def test_a_mean_over_fewer_frames_says_so_and_is_not_compared() -> None:
    stages: dict[str, Scores] = {
        "before": {"mae": 2.0, "frames": 2},
        "after": {"mae": 1.0, "frames": 3},
        "linear": {"mae": 4.0, "frames": 3},
    }
    titles = tables.stage_titles(result_record("net", alignment=ALIGNED, weights={"net": 1.0}))
    (table,) = tables.means_tables({"ground_truth": stages}, "m", titles, ("mae",))
    assert texts(table) == [
        ["net, aligned with the points (over 2 frames)", "2.0000 m", "–"],
        ["net, residual propagated", "1.0000 m", "-75.0%"],
        ["linear interpolation of all points", "4.0000 m", ""],
    ]


def test_a_csv_has_keys_lines_that_end_in_a_newline_and_nothing_for_none() -> None:
    table = Table(columns=["name", MEASURES[0]], rows=[["a,b", -1.5], ["c", None]])
    assert table.csv() == 'name,rmse\n"a,b",-1.5\nc,\n'


def test_the_depth_of_a_picture_is_of_the_networks_that_have_a_part() -> None:
    for net, compact, after in (
        (1.0, 0.0, "net, residual propagated"),
        (0.0, 1.0, "fused (compact 100%)"),
        (0.25, 0.75, "fused (net 25%, compact 75%)"),
    ):
        weights = {"net": net, "compact": compact}
        result = result_record("net", "compact", alignment=ALIGNED, weights=weights)
        assert tables.names_of_depths(result) == ("net, aligned with the points", after)


def test_names_are_shortened_by_what_they_share_and_numbers_stay_whole() -> None:
    drive = "2011_09_26_drive_0023_sync_{:010}_image_02"
    names = [drive.format(number) for number in (0, 1, 12)]
    assert tables.short_names(names[:2]) == [names[0], "…0000000001…"]
    assert tables.short_names(names) == [names[0], "…0000000001…", "…0000000012…"]
    for others in (["a_1"], ["a_1", "a_2"], ["kitchen", "office"], ["a", "a"], []):
        assert tables.short_names(others) == others


def test_without_updates_there_is_no_row_of_updates() -> None:
    at = at_points(12, before=4.0, updated=3.0, propagated=1.0, after=1.0, linear=2.0)
    record = record_of({"validation": at}, "net", weights={"net": 1.0}, loss=[1.0])
    assert not any("of z" in row[0] for row in texts(refinement_tables(record)[0]))
    record = record_of({"validation": at}, "net", weights={"net": 1.0}, loss=[1.0, 0.5])
    assert any("1 update of z" in row[0] for row in texts(refinement_tables(record)[0]))
