"""Runs compared: gains and p-values by hand, and what cannot be compared."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pnpdepth_cli.commands.evaluation.compare import Comparison, compare
from pnpdepth_cli.commands.evaluation.eval_request import EvalRequest
from pnpdepth_cli.commands.evaluation.evaluate import evaluate
from pnpdepth_cli.dataset.frame_record import FrameRecord, Scores
from pnpdepth_cli.errors import FileFormatError, InputError, UsageError
from pnpdepth_cli.io.depth import write_depth
from pnpdepth_cli.io.file_bytes import write_json
from pnpdepth_cli.measures import MEASURES


def run(root: Path, name: str, errors: dict[str, list[float]], **options: Any) -> str:
    """A saved evaluation of frames at 10 m with these errors of their pixels."""
    for frame, error in errors.items():
        for folder, depth in ((name, 10 + np.array([error])), ("gt", np.full((1, len(error)), 10))):
            (root / folder).mkdir(exist_ok=True)
            write_depth(root / folder / f"{frame}.npy", depth.astype(np.float32))
    request = EvalRequest(prediction=root / name, ground_truth=root / "gt", **options)
    path = root / f"{name}.json"
    write_json(path, evaluate(request).to_json())
    return str(path)


def summary(folder: Path, *records: FrameRecord) -> Path:
    """The summary of a batch of these frames."""
    folder.mkdir(exist_ok=True)
    path = folder / "summary.json"
    write_json(path, {"command": "batch", "frames": [record.to_json() for record in records]})
    return path


def names_of(comparison: Comparison) -> list[str]:
    return [run.name for run in comparison.runs]


FIRST = {"a": [2.0, 2.0], "b": [4.0, 4.0], "c": [1.0, 1.0]}
BETTER = {"a": [1.0, 1.0], "b": [3.0, 3.0], "c": [0.5, 0.5]}


def test_a_lower_error_is_a_positive_gain(tmp_path: Path) -> None:
    comparison = compare([run(tmp_path, "one", FIRST), run(tmp_path, "two", BETTER)])
    gain = comparison.runs[1].gains["mae"]
    assert gain.percent == pytest.approx(100 * 2.5 / 7)
    assert gain.p_value == 2 / 8  # all three got better: two of the eight swaps differ as much
    assert np.isnan([gain.low_percent, gain.high_percent]).all()  # three frames are too few
    assert names_of(comparison) == ["one", "two"]
    assert comparison.runs[0].mean["mae"] == pytest.approx(7 / 3)
    (note,) = comparison.notes
    assert note.startswith("warning: 3 frames are too few")


def test_a_run_is_no_better_than_itself_and_one_is_not_compared(tmp_path: Path) -> None:
    path = run(tmp_path, "one", FIRST)
    comparison = compare([path, path])
    for gain in comparison.runs[1].gains.values():
        assert (gain.percent, gain.p_value, gain.p_adjusted) == (0, 1, 1)
    assert names_of(comparison) == [path, path]
    assert comparison.to_json()["runs"][1]["gains"]["mae"]["low_percent"] is None
    with pytest.raises(UsageError):
        compare([path])


def test_frames_are_paired_by_name_and_the_others_reported(tmp_path: Path) -> None:
    one = run(tmp_path, "one", {"a": [2.0], "only one": [9.0]})
    (tmp_path / "gt" / "only one.npy").unlink()
    comparison = compare([one, run(tmp_path, "two", {"a": [1.0]})])
    gain = comparison.runs[1].gains["mae"]
    assert (comparison.frames, gain.percent) == (("a",), pytest.approx(50))
    assert np.isnan(gain.p_value)  # of one frame there is nothing to resample
    assert comparison.notes[0].endswith("left out: only one")


def test_six_frames_have_an_interval_around_the_gain_and_p_is_adjusted(tmp_path: Path) -> None:
    errors, factors = [2.0, 5.0, 1.0, 4.0, 1.5, 3.0], [0.5, 0.8, 0.6, 0.7, 0.9, 0.55]
    better = np.multiply(errors, factors).tolist()
    paths = [
        run(tmp_path, name, {f"{n:04}": [error] for n, error in enumerate(row)})
        for name, row in (("one", errors), ("two", better))
    ]
    main, every = compare(paths), [measure.key for measure in MEASURES]
    for comparison, count in ((main, 4), (compare(paths, columns=every), len(every))):
        gains = comparison.runs[1].gains.values()
        assert len(comparison.measures) == len(gains) == count
        smallest = min(gains, key=lambda gain: gain.p_value)
        assert smallest.p_adjusted == pytest.approx(min(1, count * smallest.p_value))
    gain = main.runs[1].gains["mae"]
    assert gain.low_percent < gain.percent < gain.high_percent
    assert gain.p_value == 2 / 64
    for other in compare([*paths, paths[1]]).runs[1:]:
        assert other.gains["mae"].p_adjusted >= gain.p_adjusted > gain.p_value
    chosen = compare(paths, columns=("delta1", "silog")).measures
    assert [measure.key for measure in chosen] == ["delta1", "silog"]


def test_a_measure_that_a_frame_lacks_is_compared_over_the_other_frames(tmp_path: Path) -> None:
    rng, paths, means = np.random.default_rng(0), [], []
    for name, size in (("c", 1.0), ("d", 0.5)):
        errors = {f"{n:04}": (size * rng.uniform(1, 2, 4)).tolist() for n in range(9)}
        path = Path(run(tmp_path, name, errors))
        record = json.loads(path.read_text())
        scores = [frame["errors"]["ground_truth"]["after"] for frame in record["frames"]]
        scores[0]["imae"] = None
        path.write_text(json.dumps(record))
        means.append(np.mean([each["imae"] for each in scores[1:]]))
        paths.append(str(path))
    comparison = compare(paths, columns=("mae", "imae"))
    gain = comparison.runs[1].gains["imae"]
    assert comparison.runs[0].mean["imae"] == pytest.approx(means[0])
    assert gain.percent == pytest.approx(100 * (1 - means[1] / means[0]))
    assert gain.p_value == 2 / 2**8
    assert any(note.startswith("iMAE: over 8 of 9 frames") for note in comparison.notes)


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
    (note,) = compare([one, run(tmp_path, "less", {"a": [1.0, -10.0]})]).notes
    assert note.startswith("warning: 1 frame with other numbers of scored pixels")
    assert "100.00%, 50.00%" in note


SCORES: dict[str, Scores] = {
    "before": {"rmse": 2.0, "mae": 1.5, "delta1": 0.5, "pixels": 90, "coverage": 0.9},
    "after": {"rmse": 1.0, "mae": 1.2, "delta1": 0.6, "pixels": 90, "coverage": 0.9},
}
WITH_MRE: dict[str, Scores] = {stage: scores | {"mre": 0.5} for stage, scores in SCORES.items()}


def test_a_batch_is_compared_with_what_it_started_from_by_groups(tmp_path: Path) -> None:
    records = [
        FrameRecord(name=f"{n}", group="abc"[n % 3], errors={"ground_truth": scores})
        for n, scores in enumerate([WITH_MRE, *[SCORES] * 8])
    ]
    path = summary(tmp_path / "x", *records, FrameRecord(name="drive/3", status="failed"))
    comparison = compare([f"{path}:before", str(tmp_path / "x")])
    assert len(comparison.frames) == 9
    gains = comparison.runs[1].gains
    assert list(gains) == ["rmse", "mae", "delta1"]
    assert (gains["rmse"].percent, gains["delta1"].percent) == (50, pytest.approx(20))
    assert gains["mae"].p_value == 2 / 8
    assert comparison.notes[-1].startswith("warning: 3 groups of frames are too few")
    assert names_of(comparison) == ["x:before", "x"]


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
    for other in (str(tmp_path / "broken.json"), f"{one}:before"):
        with pytest.raises(FileFormatError, match=r"broken\.json|one\.json"):
            compare([one, other])
