"""The plot of a comparison: what lies along its axis, and which lines it has."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import pytest

from pnpdepth_cli.commands.evaluation.compare import compare, plot_comparison
from pnpdepth_cli.dataset.frame_record import FrameRecord, Scores
from pnpdepth_cli.errors import OutputError, UsageError
from pnpdepth_cli.io.file_bytes import write_json


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


def test_numbers_lie_along_the_axis_and_names_make_lines(
    tmp_path: Path, figures: list[Any]
) -> None:
    errors = {("100", "x"): 0.5, ("20", "x"): 0.75, ("20", "y"): 0.5, ("100", "y"): 1.25}
    runs = [batch(tmp_path, mae, sample=count, loss=loss) for (count, loss), mae in errors.items()]
    comparison = compare(runs)
    assert [run.name for run in comparison.runs] == ["100,x", "20,x", "20,y", "100,y"]
    plot_comparison(comparison, tmp_path / "p.svg")
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


def test_a_point_is_the_mean_over_seeds(tmp_path: Path, figures: list[Any]) -> None:
    errors = {("20", "0"): 0.75, ("20", "1"): 0.25, ("100", "0"): 0.5}
    runs = [batch(tmp_path, mae, sample=count, seed=seed) for (count, seed), mae in errors.items()]
    plot_comparison(compare(runs), tmp_path / "p.svg")
    above, below = figures[0].axes
    lines = [line.get_xydata().tolist() for line in above.get_lines()][:2]
    assert (below.get_xlabel(), lines) == ("sample", [[[20, 1], [100, 1]], [[20, 0.5], [100, 0.5]]])


def test_names_alone_lie_side_by_side_in_their_order(tmp_path: Path, figures: list[Any]) -> None:
    runs = [batch(tmp_path, 0.5, method=name) for name in ("paper", "fused")]
    for name in ("one.png", "two.png"):
        plot_comparison(compare(runs), tmp_path / name)
    (_, below), ticks = figures[0].axes, figures[0].axes[1].get_xticklabels()
    assert [tick.get_text() for tick in ticks] == ["paper", "fused"]
    assert below.get_lines()[0].get_xdata().tolist() == [0, 1]
    assert (tmp_path / "one.png").read_bytes() == (tmp_path / "two.png").read_bytes()


def test_runs_that_do_not_vary_the_same_options_have_no_plot(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    one, two = batch(tmp_path, 0.5, lr="1%"), batch(tmp_path, 0.5, loss="l2")
    with pytest.raises(UsageError, match="same options"):
        plot_comparison(compare([one, two]), tmp_path / "p.png")
    assert not (tmp_path / "p.png").exists()


def test_a_plot_needs_a_known_format_matplotlib_and_leave_to_replace_a_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("matplotlib")
    comparison = compare([batch(tmp_path, 0.5, lr="1%"), batch(tmp_path, 0.5, lr="3%")])
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
