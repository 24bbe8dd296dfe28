"""The plot of a study: its axis, its lines, and what is no plot."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any
from unittest import mock

import pytest

from pnpdepth_cli.commands.compare import compare
from pnpdepth_cli.commands.comparisons.comparison import Comparison
from pnpdepth_cli.commands.comparisons.comparison_plot import plot_comparison
from pnpdepth_cli.errors import OutputError, UsageError
from tests.commands.runs import refined


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
