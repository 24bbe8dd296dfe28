"""Runs compared: gains and p-values by hand, and what cannot be compared."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from pnpdepth_cli.commands.compare import compare
from pnpdepth_cli.commands.comparisons.comparison import Comparison
from pnpdepth_cli.commands.comparisons.comparison_tables import (
    comparison_table,
    methods_table,
)
from pnpdepth_cli.dataset.frame_record import Scores
from pnpdepth_cli.errors import InputError, UsageError
from pnpdepth_cli.io.file_bytes import write_json
from tests.commands.predictions import frame, scored
from tests.commands.runs import compared_by_factors, refined, run, saved


def test_a_lower_error_is_a_gain_in_per_cent_of_the_first_run(tmp_path: Path) -> None:
    comparison, before, after = compared_by_factors(tmp_path, 6)
    first, second = comparison.runs
    assert (first.name, first.gains, second.name) == ("one", {}, "two")
    assert first.mean["mae"] == pytest.approx(before)
    assert second.gains["mae"].percent == pytest.approx(100 * (1 - after / before))


@pytest.mark.parametrize("frames", [3, 6])
def test_the_p_value_is_the_part_of_the_swaps_that_differ_as_much(
    tmp_path: Path, frames: int
) -> None:
    comparison, *_ = compared_by_factors(tmp_path, frames)
    # All got better: two of the swaps differ as much.
    assert comparison.runs[1].gains["mae"].p_value == 2 / 2**frames


def test_six_frames_have_an_interval_around_the_gain(tmp_path: Path) -> None:
    comparison, *_ = compared_by_factors(tmp_path, 6)
    gain = comparison.runs[1].gains["mae"]
    assert gain.low_percent < gain.percent < gain.high_percent
    (_, of_json) = json.loads(json.dumps(comparison.to_json()))["runs"]
    assert of_json["gains"]["mae"]["low_percent"] == gain.low_percent
    assert "–" not in comparison_table(comparison).rows[1][4:6]


def test_three_frames_have_no_interval_anywhere(tmp_path: Path) -> None:
    comparison, *_ = compared_by_factors(tmp_path, 3)
    gain = comparison.runs[1].gains["mae"]
    assert np.isnan([gain.low_percent, gain.high_percent]).all()
    (_, of_json) = json.loads(json.dumps(comparison.to_json()))["runs"]
    assert of_json["gains"]["mae"]["low_percent"] is None
    assert comparison_table(comparison).rows[1][4:6] == ["–", "–"]


@pytest.mark.parametrize("frames", [3, 6])
def test_few_frames_are_warned_of(tmp_path: Path, frames: int) -> None:
    comparison, *_ = compared_by_factors(tmp_path, frames)
    (note,) = comparison.notes
    assert note.startswith(f"warning: {frames} frames")


def test_p_values_are_adjusted_for_the_number_of_measures_and_runs(tmp_path: Path) -> None:
    errors = np.random.default_rng(0).uniform(0.5, 1, 12)
    one = run(tmp_path / "one", errors)
    two = run(tmp_path / "two", errors / 2)
    for runs, columns, tests in (
        ([one, two], ["mae"], 1),
        ([one, two, two], ["rmse", "mae"], 4),
        ([one, two], ["rmse", "mae", "delta1"], 3),
    ):
        gains = compare(runs, columns=columns).runs[1].gains
        assert [*gains] == columns
        assert gains["mae"].p_adjusted == pytest.approx(tests * 2 / 2**12)
    for gain in compare([one, one]).runs[1].gains.values():
        assert (gain.percent, gain.p_value, gain.p_adjusted) == (0, 1, 1)
    with pytest.raises(UsageError):
        compare([one])


def test_what_not_all_runs_have_is_left_out_and_reported(tmp_path: Path) -> None:
    one, two = np.random.default_rng(0).uniform(1, 2, (2, 9)) * [[1], [0.5]]
    paths = []
    for name, errors in (("one", [*one, 9.0]), ("two", two)):
        frames: list[dict[str, Scores]] = [{"after": {"mae": e, "imae": e}} for e in errors]
        frames[0]["after"]["imae"] = None
        paths.append(saved(tmp_path / name, *frames))
    comparison = compare(paths, columns=("mae", "imae"))
    gain = comparison.runs[1].gains["imae"]
    assert (len(comparison.frames), gain.p_value) == (9, 2 / 2**8)
    assert comparison.runs[0].mean["imae"] == pytest.approx(one[1:].mean())
    assert gain.percent == pytest.approx(100 * (1 - two[1:].mean() / one[1:].mean()))
    assert comparison.notes[0].endswith("left out: 9")
    assert comparison.notes[1].startswith("iMAE: over 8 of 9 frames")


def test_runs_of_other_definitions_frames_or_pixels_are_refused_or_said(tmp_path: Path) -> None:
    evaluated = []
    for prediction, options in (
        ([11, 11], {}),
        ([11, 0], {}),
        ([11, 11], {"protocol": "kitti-devkit"}),
    ):
        frame(tmp_path, [prediction], [[10, 10]])
        evaluated.append(f"{tmp_path}/{len(evaluated)}.json")
        write_json(Path(evaluated[-1]), scored(tmp_path, **options).to_json())
    one, less, devkit = evaluated
    (note,) = compare([one, less]).notes
    assert note.startswith("warning: 1 frame with other numbers of scored pixels")
    assert "100.00%, 50.00%" in note
    with pytest.raises(InputError, match="definitions usual and kitti-devkit"):
        compare([one, devkit])
    with pytest.raises(InputError, match="no scored frame in common: a; and 0"):
        compare([one, run(tmp_path / "other", [1.0])])


@pytest.fixture
def with_its_start(tmp_path: Path) -> Comparison:
    """A batch of nine frames in three groups against what it started from.

    The first frame alone has an MRE.
    """
    stages: dict[str, Scores] = {
        "before": {"rmse": 2.0, "mae": 1.5, "delta1": 0.5},
        "after": {"rmse": 1.0, "mae": 1.2, "delta1": 0.6},
    }
    with_mre = {stage: scores | {"mre": 0.5} for stage, scores in stages.items()}
    path = saved(tmp_path / "x", with_mre, *[stages] * 8, groups="abcabcabc")
    return compare([f"{path}:before", str(tmp_path / "x")])


def test_a_batch_is_compared_with_what_it_started_from(with_its_start: Comparison) -> None:
    assert [run.name for run in with_its_start.runs] == ["x:before", "x"]
    assert len(with_its_start.frames) == 9
    gains = with_its_start.runs[1].gains
    assert [*gains] == ["rmse", "mae", "delta1"]
    assert (gains["rmse"].percent, gains["delta1"].percent) == (50, pytest.approx(20))


def test_frames_of_a_group_are_swapped_together(with_its_start: Comparison) -> None:
    assert with_its_start.runs[1].gains["mae"].p_value == 2 / 2**3
    assert with_its_start.notes[-1].startswith("warning: 3 groups")


def test_errors_before_are_averaged_over_the_frames_of_those_after(tmp_path: Path) -> None:
    frames: list[dict[str, Scores]] = [
        {"before": {"mae": before}, "after": {"mae": after}}
        for before, after in ((2.0, 1.0), (4.0, 3.0), (90.0, None))
    ]
    one, two = (saved(tmp_path / name, *frames) for name in ("one", "two"))
    (first, _) = compare([one, two], columns=["mae"]).runs
    assert (first.before["mae"], first.mean["mae"]) == (3, 2)


@pytest.mark.parametrize("first", ["0", "20"])
def test_runs_of_a_study_are_in_the_order_of_its_values(tmp_path: Path, first: str) -> None:
    counts = sorted(["0", "5", "20", "100"], key=lambda count: (count != first, count))
    runs = [refined(tmp_path, 1 / (1 + int(count)), iterations=count) for count in counts]
    comparison = compare(runs, columns=["mae"])
    assert [run.varied["iterations"] for run in comparison.runs] == ["0", "5", "20", "100"]
    assert comparison.reference.varied["iterations"] == first
    expected = 100 * (1 - (1 + int(first)) / 101)
    assert comparison.runs[3].gains["mae"].percent == pytest.approx(expected)
    for table in (comparison_table(comparison), methods_table(comparison)):
        assert f"of {comparison.reference.name}," in table.title or "differs from" in table.title
