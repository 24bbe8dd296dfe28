"""Runs compared: gains and p-values by hand, and what cannot be compared."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pnpdepth_cli.commands.evaluation.compare import compare
from pnpdepth_cli.commands.evaluation.eval_request import EvalRequest
from pnpdepth_cli.commands.evaluation.evaluate import evaluate
from pnpdepth_cli.dataset.frame_record import FrameRecord, Scores
from pnpdepth_cli.errors import FileFormatError, InputError
from pnpdepth_cli.io.depth import write_depth
from pnpdepth_cli.io.text_files import write_json
from pnpdepth_cli.measures import MEASURES


def run(root: Path, name: str, errors: dict[str, list[float]], **frames: Any) -> str:
    """A saved evaluation of frames of 4 pixels at 10 m with these errors."""
    for frame, error in errors.items():
        for folder, depth in ((name, 10 + np.array([error])), ("gt", np.full((1, len(error)), 10))):
            (root / folder).mkdir(exist_ok=True)
            write_depth(root / folder / f"{frame}.npy", depth.astype(np.float32))
    request = EvalRequest(prediction=root / name, ground_truth=root / "gt", **frames)
    path = root / f"{name}.json"
    write_json(path, evaluate(request).to_json())
    return str(path)


def summary(folder: Path, *records: FrameRecord) -> Path:
    """The summary of a batch of these frames."""
    path = folder / "summary.json"
    write_json(path, {"command": "batch", "frames": [record.to_json() for record in records]})
    return path


FIRST = {"a": [2.0, 2.0], "b": [4.0, 4.0], "c": [1.0, 1.0]}
BETTER = {"a": [1.0, 1.0], "b": [3.0, 3.0], "c": [0.5, 0.5]}


def test_a_lower_error_is_a_positive_gain(tmp_path: Path) -> None:
    comparison = compare([run(tmp_path, "one", FIRST), run(tmp_path, "two", BETTER)])
    gain = comparison.runs[1].gains["mae"]
    assert gain.percent == pytest.approx(100 * 2.5 / 7)
    assert gain.difference == pytest.approx(-2.5 / 3)
    assert gain.p_value == 2 / 8  # all three got better: two of the eight swaps differ as much
    assert np.isnan([gain.low_percent, gain.high_percent]).all()  # three frames are too few
    assert [run.name for run in comparison.runs] == ["one", "two"]
    assert comparison.runs[0].mean["mae"] == pytest.approx(7 / 3)
    (note,) = comparison.notes
    assert note.startswith("warning: 3 frames are too few")
    assert "p is at least 0.25, adjusted 1" in note


def test_a_run_is_no_better_than_itself(tmp_path: Path) -> None:
    path = run(tmp_path, "one", FIRST)
    comparison = compare([path, path])
    for gain in comparison.runs[1].gains.values():
        assert (gain.percent, gain.p_value, gain.p_adjusted) == (0, 1, 1)
    assert [run.name for run in comparison.runs] == [path, path]


def test_frames_are_paired_by_name_and_the_others_reported(tmp_path: Path) -> None:
    one = run(tmp_path, "one", {"a": [2.0], "b": [4.0], "only one": [9.0]})
    (tmp_path / "gt" / "only one.npy").unlink()
    comparison = compare([one, run(tmp_path, "two", {"b": [2.0], "a": [1.0]})])
    assert (comparison.frames, comparison.runs[0].mean["mae"]) == (("a", "b"), pytest.approx(3))
    assert comparison.notes[0].endswith("left out: only one")


def test_one_frame_has_a_gain_but_nothing_to_resample(tmp_path: Path) -> None:
    comparison = compare([run(tmp_path, "one", {"a": [2.0]}), run(tmp_path, "two", {"a": [1.0]})])
    gain = comparison.runs[1].gains["mae"]
    assert gain.percent == pytest.approx(50)
    assert np.isnan([gain.low_percent, gain.high_percent, gain.p_value]).all()


SIX = {f"{n:04}": [error] for n, error in enumerate((2.0, 5.0, 1.0, 4.0, 1.5, 3.0))}


def scaled(errors: dict[str, list[float]], factors: list[float]) -> dict[str, list[float]]:
    rows = zip(errors.items(), factors, strict=True)
    return {name: (np.array(row) * factor).tolist() for (name, row), factor in rows}


def test_six_frames_have_an_interval_around_the_gain_and_p_is_adjusted(tmp_path: Path) -> None:
    better = scaled(SIX, [0.5, 0.8, 0.6, 0.7, 0.9, 0.55])
    paths = [run(tmp_path, "one", SIX), run(tmp_path, "two", better)]
    main = compare(paths)
    every = [measure.key for measure in MEASURES]
    everything = compare(paths, columns=every)
    for comparison, count in ((main, 4), (everything, len(every))):
        gains = comparison.runs[1].gains.values()
        assert len(comparison.measures) == len(gains) == count
        smallest = min(gains, key=lambda gain: gain.p_value)
        assert smallest.p_adjusted == pytest.approx(min(1, count * smallest.p_value))
    gain = main.runs[1].gains["mae"]
    assert gain.low_percent < gain.percent < gain.high_percent
    assert gain.p_value == everything.runs[1].gains["mae"].p_value == 2 / 64
    (note,) = main.notes
    assert note.endswith("4 tests: p is at least 0.031, adjusted 0.12")
    of_three = compare([*paths, paths[1]])
    for other in of_three.runs[1:]:
        own = other.gains["mae"]
        assert own.p_adjusted >= gain.p_adjusted > own.p_value
    chosen = compare(paths, columns=("delta1", "silog")).measures
    assert [measure.key for measure in chosen] == ["delta1", "silog"]


def test_a_measure_that_a_frame_lacks_is_compared_over_the_other_frames(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    first = {f"{n:04}": rng.uniform(1, 2, 4).tolist() for n in range(9)}
    second = scaled(first, rng.uniform(0.4, 0.6, 9).tolist())
    paths, values = [run(tmp_path, name, e) for name, e in (("c", first), ("d", second))], []
    for path in paths:
        record = json.loads(Path(path).read_text())
        scores = [frame["errors"]["ground_truth"]["after"] for frame in record["frames"]]
        scores[0]["imae"] = None
        values.append(np.mean([each["imae"] for each in scores[1:]]))
        Path(path).write_text(json.dumps(record))
    comparison = compare(paths, columns=("mae", "imae"))
    gain = comparison.runs[1].gains["imae"]
    assert comparison.runs[0].mean["imae"] == pytest.approx(values[0])
    assert gain.percent == pytest.approx(100 * (1 - values[1] / values[0]))
    assert gain.p_value == 2 / 2**8
    assert any(note.startswith("iMAE: over 8 of 9 frames") for note in comparison.notes)


def test_frames_of_one_group_of_a_batch_are_swapped_together(tmp_path: Path) -> None:
    errors = {"ground_truth": SCORES}
    path = summary(
        tmp_path, *(FrameRecord(name=f"{n}", group="abc"[n % 3], errors=errors) for n in range(9))
    )
    comparison = compare([f"{path}:before", str(path)])
    assert comparison.runs[1].gains["mae"].p_value == 2 / 8
    assert comparison.notes[-1].startswith("warning: 3 groups of frames are too few")


def test_runs_of_other_definitions_or_without_a_common_frame_are_refused(tmp_path: Path) -> None:
    one = run(tmp_path, "one", {"a": [1.0]})
    devkit = run(tmp_path, "three", {"a": [1.0]}, protocol="kitti-devkit")
    with pytest.raises(InputError, match="definitions usual and kitti-devkit"):
        compare([one, devkit])
    (tmp_path / "gt" / "a.npy").unlink()
    with pytest.raises(InputError, match="no scored frame in common: a; and b"):
        compare([one, run(tmp_path, "two", {"b": [1.0]})])


def test_other_pixels_cause_a_warning(tmp_path: Path) -> None:
    one = run(tmp_path, "one", {"a": [1.0, 1.0]})
    less = run(tmp_path, "less", {"a": [1.0, -10.0]})
    (note,) = compare([one, less]).notes
    assert note.startswith("warning: 1 frame with other numbers of scored pixels")
    assert "100.00%, 50.00%" in note


SCORES: dict[str, Scores] = {
    "before": {"rmse": 2.0, "mae": 1.5, "delta1": 0.5, "pixels": 90, "coverage": 0.9},
    "after": {"rmse": 1.0, "mae": 1.2, "delta1": 0.6, "pixels": 90, "coverage": 0.9},
}


WITH_MRE: dict[str, Scores] = {stage: scores | {"mre": 0.5} for stage, scores in SCORES.items()}


def test_a_batch_is_compared_with_what_it_started_from(tmp_path: Path) -> None:
    summary(
        tmp_path,
        FrameRecord(name="drive/1", errors={"ground_truth": SCORES}),
        FrameRecord(name="drive/2", errors={"ground_truth": WITH_MRE}),
        FrameRecord(name="drive/3", status="failed"),
    )
    for result in (tmp_path, tmp_path / "summary.json"):
        comparison = compare([f"{tmp_path}/summary.json:before", str(result)])
        assert comparison.frames == ("drive/1", "drive/2")
        assert [measure.key for measure in comparison.measures] == ["rmse", "mae", "delta1"]
        assert comparison.runs[1].gains["rmse"].percent == 50
        assert comparison.runs[1].gains["delta1"].percent == pytest.approx(20)
        name = tmp_path.name
        assert [run.name for run in comparison.runs] == [f"{name}:before", name]


BROKEN = [
    '{"frames": []}',
    '{"frames": [1]}',
    '{"frames": [{"errors": {"ground_truth": {}}}]}',
    '{"command": "eval", "protocol": {"name": "other"}, "measures": []}',
]


@pytest.mark.parametrize("text", BROKEN)
def test_a_file_without_scores_is_refused(tmp_path: Path, text: str) -> None:
    one = run(tmp_path, "one", FIRST)
    (tmp_path / "broken.json").write_text(text)
    with pytest.raises(FileFormatError, match=r"broken\.json"):
        compare([one, str(tmp_path / "broken.json")])


def test_before_is_only_for_what_has_one(tmp_path: Path) -> None:
    one = run(tmp_path, "one", FIRST)
    with pytest.raises(FileFormatError):
        compare([one, f"{one}:before"])


def test_runs_are_named_by_their_folders_and_files_or_by_their_paths(tmp_path: Path) -> None:
    for folder in "ab":
        (tmp_path / folder).mkdir()
    paths = [run(tmp_path / folder, "run", FIRST) for folder in "ab"]
    assert [run.name for run in compare(paths).runs] == paths
    summary(tmp_path / "a", FrameRecord(name="drive/1", errors={"ground_truth": SCORES}))
    both = [f"{tmp_path}/a/summary.json:before", f"{tmp_path}/a"]
    assert [run.name for run in compare(both).runs] == ["a:before", "a"]
