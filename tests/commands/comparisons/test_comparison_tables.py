"""Tables of compared runs: for a paper and for programs."""

from __future__ import annotations

import csv
import io
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pnpdepth_cli.commands.compare import compare
from pnpdepth_cli.commands.comparisons.comparison_tables import (
    comparison_table,
    comparison_values,
    methods_table,
)
from tests.commands.runs import refined, run


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


def test_a_csv_for_programs_has_keys_numbers_in_full_and_empty_cells(tmp_path: Path) -> None:
    runs = [refined(tmp_path, mae, iterations=n) for n, mae in (("0", 1.0), ("5", 2 / 3))]
    first, second = csv.DictReader(io.StringIO(comparison_values(compare(runs)).csv()))
    assert first["measure"] == "mae"
    assert (first["iterations"], second["iterations"]) == ("0", "5")
    assert float(second["mean"]) == 2 / 3
    assert float(second["percent"]) == pytest.approx(100 / 3, abs=1e-12)
    assert (first["percent"], second["low_percent"]) == ("", "")  # one frame has no interval
