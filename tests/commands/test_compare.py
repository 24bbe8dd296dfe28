"""Runs compared: gains and p-values by hand, what cannot be compared, and the plot."""

from __future__ import annotations

import csv
import io
import json
import re
import sys
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pytest

from pnpdepth_cli.commands.compare import (
    Comparison,
    compare,
    comparison_table,
    comparison_values,
    methods_table,
    plot_comparison,
)
from pnpdepth_cli.dataset.frame_record import FrameRecord, Scores
from pnpdepth_cli.errors import InputError, OutputError, UsageError
from pnpdepth_cli.io.file_bytes import write_json
from tests.commands.predictions import frame, scored


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


def compared_by_factors(folder: Path, frames: int) -> tuple[Comparison, float, float]:
    """Two runs of which the second is better on every frame, and their mean errors."""
    errors, factors = np.random.default_rng(0).uniform(0.5, 0.9, (2, frames))
    better = errors * factors
    comparison = compare([run(folder / "one", errors), run(folder / "two", better)])
    return comparison, errors.mean(), better.mean()


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


def test_the_best_of_a_column_is_bold_and_p_values_are_stars_and_colours(tmp_path: Path) -> None:
    errors = np.random.default_rng(0).uniform(0.5, 1, 12)
    factors = {"a": 1.0, "b": 0.5, "c": 2.0}
    paths = [run(tmp_path / name, factor * errors) for name, factor in factors.items()]
    comparison = compare(paths, columns=("mae", "delta1"))
    methods, gains = methods_table(comparison), comparison_table(comparison)
    a, b, c = (f"{factor * errors.mean():.4f}" for factor in factors.values())
    # all got better, or worse: two of 2^12 swaps, times four tests
    assert methods.cells == [
        [("a", ""), (a, ""), ("100.00%", "bold")],
        [("b", ""), (f"{b}**", "bold"), ("100.00%", "bold")],
        [("c", ""), (f"{c}**", ""), ("100.00%", "bold")],
    ]
    shown = [row[3] for row in gains.cells]
    assert shown[:3] == [("–", ""), ("+50.00", "good"), ("-100.00", "bad")]
    assert shown[3:] == [("–", ""), ("+0.00", "dim"), ("+0.00", "dim")]
    assert gains.rows[1][4:] == ["+50.00", "+50.00", "0.0020"]
    without = replace(comparison, scoring={"exclude_sparse": True})
    for table in (methods_table(without), comparison_table(without)):
        assert table.title.endswith("; without the pixels of sparse points")


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


BROKEN = ['{"frames": [1]}', '{"frames": [{"errors": {"ground_truth": {}}}]}', '{"measures": []}']


@pytest.mark.parametrize("text", BROKEN)
def test_a_file_without_scores_is_refused(tmp_path: Path, text: str) -> None:
    one = run(tmp_path / "one", [1.0])
    (tmp_path / "broken.json").write_text(text)
    for without_scores in (str(tmp_path / "broken.json"), f"{one}:before"):
        with pytest.raises(InputError, match=r"broken\.json|one") as error:
            compare([one, without_scores])
        assert "ValueError" not in str(error.value)


@pytest.mark.parametrize(
    "wrong", [{"better": None}, {"better": []}, {"decimals": "x"}, {"shown_factor": ""}, {"key": 5}]
)
def test_a_file_whose_measures_cannot_be_shown_is_refused(
    tmp_path: Path, wrong: dict[str, object]
) -> None:
    frame(tmp_path, [[11, 11]], [[10, 10]])
    good = scored(tmp_path).to_json()
    measures = good["measures"]
    assert isinstance(measures, list)
    for name, first in (("good", measures[0]), ("bad", measures[0] | wrong)):
        write_json(tmp_path / f"{name}.json", good | {"measures": [first, *measures[1:]]})
    paths = [str(tmp_path / f"{name}.json") for name in ("good", "bad")]
    compare([paths[0], paths[0]])
    with pytest.raises(InputError, match=r"bad\.json"):
        compare(paths)


def refined(folder: Path, mae: float, **varied: str) -> str:
    """A batch of one frame whose MAE was 1 m before refinement."""
    stages: dict[str, Scores] = {"before": {"mae": 1.0}, "after": {"mae": mae}}
    return saved(folder / ",".join(varied.values()), stages, varied=varied)


def plotted(comparison: Comparison, path: Path) -> Any:
    """The figure that is written."""
    figure = pytest.importorskip("matplotlib.figure").Figure
    with mock.patch.object(figure, "savefig", autospec=True, side_effect=figure.savefig) as saving:
        plot_comparison(comparison, path)
    return saving.call_args.args[0]


def test_a_plot_has_an_axis_lines_and_means_over_seeds(tmp_path: Path) -> None:
    errors = {"100 x 0": 0.5, "20 x 0": 1.0, "20 x 1": 0.5, "20 y 0": 0.5, "100 y 0": 1.25}
    runs = []
    for values, mae in errors.items():
        count, loss, seed = values.split()
        runs.append(refined(tmp_path, mae, sample=count, loss=loss, seed=seed))
    figure = plotted(compare(runs), tmp_path / "p.svg")
    above, below = figure.axes
    assert (below.get_xlabel(), below.get_xscale()) == ("sample", "log")
    lines = {line.get_label(): line.get_xydata().tolist() for line in above.get_lines()}
    assert lines["loss=x"] == [[20, 0.75], [100, 0.5]]
    assert lines["loss=y"] == [[20, 0.5], [100, 1.25]]
    assert [line.get_ydata().tolist() for line in below.get_lines()] == [[25, 50], [50, -25]]
    (legend,) = figure.legends
    named = [text.get_text() for text in legend.get_texts()]
    assert named == ["loss=x", "loss=y", "before refinement"]


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


def test_a_csv_for_programs_has_keys_numbers_in_full_and_empty_cells(tmp_path: Path) -> None:
    runs = [refined(tmp_path, mae, iterations=n) for n, mae in (("0", 1.0), ("5", 2 / 3))]
    first, second = csv.DictReader(io.StringIO(comparison_values(compare(runs)).csv()))
    assert first["measure"] == "mae"
    assert (first["iterations"], second["iterations"]) == ("0", "5")
    assert float(second["mean"]) == 2 / 3
    assert float(second["percent"]) == pytest.approx(100 / 3, abs=1e-12)
    assert (first["percent"], second["low_percent"]) == ("", "")  # one frame has no interval


def test_a_run_without_updates_is_a_point_of_each_line(tmp_path: Path) -> None:
    pairs = [("5", "1%", 0.5), ("5", "3%", 0.25), ("20", "1%", 0.3), ("20", "3%", 0.2)]
    runs = [refined(tmp_path, 1.0, iterations="0")]
    runs += [refined(tmp_path, mae, iterations=n, lr=lr) for n, lr, mae in pairs]
    above, below = plotted(compare(runs), tmp_path / "p.png").axes
    assert below.get_xlabel() == "iterations"
    lines = {line.get_label(): line.get_xydata().tolist() for line in above.get_lines()}
    assert lines["lr=1%"] == [[0, 1.0], [5, 0.5], [20, 0.3]]
    assert lines["lr=3%"] == [[0, 1.0], [5, 0.25], [20, 0.2]]


def test_names_alone_lie_side_by_side_in_their_order(tmp_path: Path) -> None:
    comparison = compare([refined(tmp_path, 0.5, method=name) for name in ("paper", "fused")])
    (_, below) = plotted(comparison, tmp_path / "p.png").axes
    assert [tick.get_text() for tick in below.get_xticklabels()] == ["paper", "fused"]
    assert below.get_lines()[0].get_xdata().tolist() == [0, 1]
    before = (tmp_path / "p.png").read_bytes()
    plot_comparison(comparison, tmp_path / "p.png", overwrite=True)
    assert (tmp_path / "p.png").read_bytes() == before


def test_what_is_no_plot_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("matplotlib")
    options = ({"lr": "1%"}, {"lr": "3%"}, {"loss": "l2"})
    one, two, other = (refined(tmp_path, 0.5, **varied) for varied in options)
    comparison = compare([one, two])
    with pytest.raises(UsageError, match="same options"):
        plot_comparison(compare([one, other]), tmp_path / "p.png")
    with pytest.raises(UsageError, match=r"\.svg"):
        plot_comparison(comparison, tmp_path / "p.jpg")
    (tmp_path / "p.pdf").touch()
    with pytest.raises(OutputError):
        plot_comparison(comparison, tmp_path / "p.pdf")
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(UsageError, match="plot"):
        plot_comparison(comparison, tmp_path / "p.png")


def test_runs_without_updates_at_several_step_sizes_are_listed_once(tmp_path: Path) -> None:
    study = [
        refined(tmp_path, 0.5, iterations="0", lr="0.01"),
        refined(tmp_path, 0.4, iterations="5", lr="0.01"),
        refined(tmp_path, 0.5, iterations="0", lr="0.1"),
        refined(tmp_path, 0.3, iterations="5", lr="0.1"),
    ]
    found = compare(study)
    assert [run.path for run in found.runs] == [study[0], study[1], study[3]]
    assert found.reference.varied == {"iterations": "0"}
    (said,) = (note for note in found.notes if study[2] in note)
    assert study[0] in said
    # A run whose scores differ is another result, whatever its settings.
    other = refined(tmp_path, 0.6, iterations="0", lr="0.2")
    assert len(compare([study[0], other]).runs) == 2


def test_runs_that_all_gave_one_result_are_nothing_to_compare(tmp_path: Path) -> None:
    study = [refined(tmp_path, 0.5, iterations="0", lr=lr) for lr in ("0.01", "0.1")]
    with pytest.raises(UsageError, match=re.escape(study[1])):
        compare(study)
