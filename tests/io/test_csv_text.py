"""No cell of a CSV file is a formula to a spreadsheet."""

from __future__ import annotations

import csv
import io

import pytest

from pnpdepth_cli.io.csv_text import text_cell, write_csv


@pytest.mark.parametrize("text", ["=1+1", "+1+1", "-1+2", "@SUM(A1)", "\t=1", "\r=1", "-", "\t1"])
def test_a_formula_becomes_text(text: str) -> None:
    assert text_cell(text) == f"'{text}"


@pytest.mark.parametrize("text", ["frame", "1=1", "'=1", "", "-0.25", "+5.20", "-1e-3", "–"])
def test_other_text_and_numbers_stay_as_they_are(text: str) -> None:
    assert text_cell(text) == text


def test_every_text_of_a_table_is_checked_and_numbers_stay_numbers() -> None:
    file = io.StringIO()
    write_csv(file, ["name", "=x"], [["@a,b", -1.5], ["c", None], ["+7.5", 3]])
    assert file.getvalue() == "name,'=x\n\"'@a,b\",-1.5\nc,\n+7.5,3\n"
    assert list(csv.reader(io.StringIO(file.getvalue())))[1] == ["'@a,b", "-1.5"]
