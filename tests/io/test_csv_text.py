"""No cell of a CSV file is a formula to a spreadsheet."""

from __future__ import annotations

import io

from pnpdepth_cli.io.text_files import write_csv

FORMULAS = ["=1+1", "+1+1", "-1+2", "@SUM(A1)", "\t=1", "-", "\t1"]
OTHERS = ["frame", "1=1", "'=1", "", "-0.25", "+5.20", "-1e-3", "–"]


def test_formulas_become_text_and_other_text_and_numbers_stay_as_they_are() -> None:
    file = io.StringIO()
    write_csv(file, ["name", "=x"], [["@a,b", -1.5], ["c", None], FORMULAS, OTHERS])
    head, comma, none, formulas, others = file.getvalue().splitlines()
    assert (head, comma, none) == ("name,'=x", '"\'@a,b",-1.5', "c,")
    assert formulas.split(",") == [f"'{text}" for text in FORMULAS]
    assert others.split(",") == OTHERS
