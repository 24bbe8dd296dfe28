"""Runs compared: gains and p-values by hand, what cannot be compared, and the plot."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pnpdepth_cli.commands.evaluation.compare import (
    compare,
    comparison_table,
    methods_table,
    plot_comparison,
)
from pnpdepth_cli.commands.evaluation.eval_request import EvalRequest
from pnpdepth_cli.commands.evaluation.evaluate import evaluate
from pnpdepth_cli.dataset.frame_record import FrameRecord, Scores
from pnpdepth_cli.errors import FileFormatError, InputError, OutputError, UsageError
from pnpdepth_cli.io.depth import write_depth
from pnpdepth_cli.io.file_bytes import write_json
from pnpdepth_cli.measures import MEASURES
from tests.commands.test_tables import styled


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


FIRST = {"a": [2.0, 2.0], "b": [4.0, 4.0], "c": [1.0, 1.0]}


def test_a_lower_error_is_a_positive_gain_and_a_run_is_no_better_than_itself(
    tmp_path: Path,
) -> None:
    one = run(tmp_path, "one", FIRST)
    two = run(tmp_path, "two", {"a": [1.0, 1.0], "b": [3.0, 3.0], "c": [0.5, 0.5]})
    comparison = compare([one, two])
    gain = comparison.runs[1].gains["mae"]
    assert gain.percent == pytest.approx(100 * 2.5 / 7)
    assert gain.p_value == 2 / 8  # all three got better: two of the eight swaps differ as much
    assert comparison_table(comparison).rows[1][4:6] == ["–", "–"]  # three frames are too few
    assert [(each.name, each.gains == {}) for each in comparison.runs] == [
        ("one", True),
        ("two", False),
    ]
    assert comparison.runs[0].mean["mae"] == pytest.approx(7 / 3)
    (note,) = comparison.notes
    assert note.startswith("warning: 3 frames are too few")

    same = compare([one, one])
    for gain in same.runs[1].gains.values():
        assert (gain.percent, gain.p_value, gain.p_adjusted) == (0, 1, 1)
    (_, of_json) = json.loads(json.dumps(same.to_json()))["runs"]
    assert (of_json["name"], of_json["gains"]["mae"]["low_percent"]) == (one, None)
    with pytest.raises(UsageError):
        compare([one])


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


def test_the_best_of_a_column_is_bold_and_stars_and_colours_are_the_p_values(
    tmp_path: Path,
) -> None:
    errors, paths = np.random.default_rng(0).uniform(0.5, 1, 12), []
    for name, factor in (("a", 1.0), ("b", 0.5), ("c", 2.0)):
        each = {f"{n}": [error] for n, error in enumerate(factor * errors)}
        path = Path(run(tmp_path, name, each))
        path.write_text(
            path.read_text().replace('"exclude_sparse": false', '"exclude_sparse": true')
        )
        paths.append(str(path))
    comparison = compare(paths, columns=("mae", "delta1"))
    methods, gains = methods_table(comparison), comparison_table(comparison)
    a, b, c = (f"{factor * errors.mean():.4f}" for factor in (1, 0.5, 2))
    # all got better, or worse: two of 2^12 swaps, times four tests
    assert styled(methods) == [
        [("a", ""), (a, ""), ("100.00%", "bold")],
        [("b", ""), (f"{b}**", "bold"), ("100.00%", "bold")],
        [("c", ""), (f"{c}**", ""), ("100.00%", "bold")],
    ]
    shown = [row[3] for row in styled(gains)]
    assert shown[:3] == [("–", ""), ("+50.00", "good"), ("-100.00", "bad")]
    assert shown[3:] == [("–", ""), ("+0.00", "dim"), ("+0.00", "dim")]
    assert gains.rows[1][4:] == ["+50.00", "+50.00", "0.0020"]
    for table in (methods, gains):
        assert table.title.endswith("; without the pixels of sparse points")


def test_what_not_all_runs_have_is_left_out_and_reported(tmp_path: Path) -> None:
    rng, paths, means = np.random.default_rng(0), [], []
    for name, size in (("c", 1.0), ("d", 0.5)):
        errors = {f"{n:04}": (size * rng.uniform(1, 2, 4)).tolist() for n in range(9)}
        path = Path(run(tmp_path, name, errors | ({"e": [9.0]} if name == "c" else {})))
        record = json.loads(path.read_text())
        scores = [frame["errors"]["ground_truth"]["after"] for frame in record["frames"][:9]]
        scores[0]["imae"] = None
        path.write_text(json.dumps(record))
        means.append(np.mean([each["imae"] for each in scores[1:]]))
        paths.append(str(path))
        (tmp_path / "gt" / "e.npy").unlink(missing_ok=True)
    comparison = compare(paths, columns=("mae", "imae"))
    gain = comparison.runs[1].gains["imae"]
    assert (len(comparison.frames), gain.p_value) == (9, 2 / 2**8)
    assert comparison.runs[0].mean["imae"] == pytest.approx(means[0])
    assert gain.percent == pytest.approx(100 * (1 - means[1] / means[0]))
    assert comparison.notes[0].endswith("left out: e")
    assert comparison.notes[1].startswith("iMAE: over 8 of 9 frames")


def test_runs_of_other_definitions_frames_or_pixels_are_refused_or_warned_of(
    tmp_path: Path,
) -> None:
    one = run(tmp_path, "one", {"a": [1.0, 1.0]})
    (note,) = compare([one, run(tmp_path, "less", {"a": [1.0, -10.0]})]).notes
    assert note.startswith("warning: 1 frame with other numbers of scored pixels")
    assert "100.00%, 50.00%" in note
    devkit = run(tmp_path, "three", {"a": [1.0, 1.0]}, protocol="kitti-devkit")
    with pytest.raises(InputError, match="definitions usual and kitti-devkit"):
        compare([one, devkit])
    (tmp_path / "gt" / "a.npy").unlink()
    with pytest.raises(InputError, match="no scored frame in common: a; and b"):
        compare([one, run(tmp_path, "two", {"b": [1.0]})])


def test_a_batch_is_compared_with_what_it_started_from_by_groups(tmp_path: Path) -> None:
    scores: dict[str, Scores] = {
        "before": {"rmse": 2.0, "mae": 1.5, "delta1": 0.5, "pixels": 90, "coverage": 0.9},
        "after": {"rmse": 1.0, "mae": 1.2, "delta1": 0.6, "pixels": 90, "coverage": 0.9},
    }
    with_mre = {stage: own | {"mre": 0.5} for stage, own in scores.items()}
    records = [
        FrameRecord(name=f"{n}", group="abc"[n % 3], errors={"ground_truth": own})
        for n, own in enumerate([with_mre, *[scores] * 8])
    ]
    frames = [each.to_json() for each in (*records, FrameRecord(name="9", status="failed"))]
    (tmp_path / "x").mkdir()
    write_json(tmp_path / "x" / "summary.json", {"command": "batch", "frames": frames})
    comparison = compare([f"{tmp_path}/x/summary.json:before", str(tmp_path / "x")])
    assert len(comparison.frames) == 9
    gains = comparison.runs[1].gains
    assert list(gains) == ["rmse", "mae", "delta1"]
    assert (gains["rmse"].percent, gains["delta1"].percent) == (50, pytest.approx(20))
    assert gains["mae"].p_value == 2 / 8
    assert comparison.notes[-1].startswith("warning: 3 groups of frames are too few")
    assert [each.name for each in comparison.runs] == ["x:before", "x"]


BROKEN = ['{"frames": [1]}', '{"frames": [{"errors": {"ground_truth": {}}}]}', '{"measures": []}']


@pytest.mark.parametrize("text", BROKEN)
def test_a_file_without_scores_is_refused(tmp_path: Path, text: str) -> None:
    one = run(tmp_path, "one", FIRST)
    (tmp_path / "broken.json").write_text(text)
    for other in (str(tmp_path / "broken.json"), f"{one}:before"):
        with pytest.raises(FileFormatError, match=r"broken\.json|one\.json"):
            compare([one, other])


def batch(folder: Path, mae: float, **varied: str) -> str:
    """The summary of a batch of one frame whose MAE was 1 m before refinement."""
    counts: Scores = {"pixels": 4, "coverage": 1.0}
    stages: dict[str, Scores] = {"before": {"mae": 1.0} | counts, "after": {"mae": mae} | counts}
    record = FrameRecord(name="a", errors={"ground_truth": stages}).to_json()
    name = ",".join(varied.values())
    (folder / name).mkdir()
    write_json(folder / name / "summary.json", {"frames": [record], "varied": varied})
    return str(folder / name)


@pytest.fixture
def figures(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """The figures that are written."""
    figure, written = pytest.importorskip("matplotlib.figure").Figure, list[Any]()
    savefig = figure.savefig
    monkeypatch.setattr(
        figure, "savefig", lambda self, *a, **k: (written.append(self), savefig(self, *a, **k))
    )
    return written


def test_numbers_lie_along_the_axis_names_make_lines_and_a_point_is_the_mean_over_seeds(
    tmp_path: Path, figures: list[Any]
) -> None:
    errors = {"100 x 0": 0.5, "20 x 0": 1.0, "20 x 1": 0.5, "20 y 0": 0.5, "100 y 0": 1.25}
    runs = []
    for values, mae in errors.items():
        count, loss, seed = values.split()
        runs.append(batch(tmp_path, mae, sample=count, loss=loss, seed=seed))
    plot_comparison(compare(runs), tmp_path / "p.svg")
    above, below = figures[0].axes
    assert (below.get_xlabel(), below.get_xscale()) == ("sample", "log")
    lines = {line.get_label(): line.get_xydata().tolist() for line in above.get_lines()}
    assert lines["loss=x"] == [[20, 0.75], [100, 0.5]]
    assert lines["loss=y"] == [[20, 0.5], [100, 1.25]]
    gains = [line.get_ydata().tolist() for line in below.get_lines()]
    assert gains == [[25, 50], [50, -25]]
    (legend,) = figures[0].legends
    named = [text.get_text() for text in legend.get_texts()]
    assert named == ["loss=x", "loss=y", "before refinement"]


def test_names_alone_lie_side_by_side_in_their_order(tmp_path: Path, figures: list[Any]) -> None:
    runs = [batch(tmp_path, 0.5, method=name) for name in ("paper", "fused")]
    for name in ("one.png", "two.png"):
        plot_comparison(compare(runs), tmp_path / name)
    (_, below), ticks = figures[0].axes, figures[0].axes[1].get_xticklabels()
    assert [tick.get_text() for tick in ticks] == ["paper", "fused"]
    assert below.get_lines()[0].get_xdata().tolist() == [0, 1]
    assert (tmp_path / "one.png").read_bytes() == (tmp_path / "two.png").read_bytes()


def test_a_plot_needs_one_option_a_known_format_leave_to_replace_a_file_and_matplotlib(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("matplotlib")
    one, two = batch(tmp_path, 0.5, lr="1%"), batch(tmp_path, 0.5, lr="3%")
    comparison = compare([one, two])
    with pytest.raises(UsageError, match="same options"):
        plot_comparison(compare([one, batch(tmp_path, 0.5, loss="l2")]), tmp_path / "p.png")
    with pytest.raises(UsageError, match=r"\.svg"):
        plot_comparison(comparison, tmp_path / "p.jpg")
    (tmp_path / "p.pdf").touch()
    with pytest.raises(OutputError):
        plot_comparison(comparison, tmp_path / "p.pdf")
    plot_comparison(comparison, tmp_path / "p.pdf", overwrite=True)
    assert (tmp_path / "p.pdf").read_bytes().startswith(b"%PDF")
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(UsageError, match="plot"):
        plot_comparison(comparison, tmp_path / "p.png")
