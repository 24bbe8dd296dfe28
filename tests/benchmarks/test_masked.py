"""The results file of the benchmark of hidden points, without a network."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from benchmarks.masked import Case, Results, Row, table

PLAIN = Row(
    network="compact",
    frames="icl_nuim",
    points=None,
    outliers=0.2,
    seed=1,
    frame="7",
    method="plain",
    mae=0.2,
    rmse=0.4,
    cpu_s=0.0,
    kept=0,
)
REFINED = replace(PLAIN, method="masked", mae=0.1, rmse=0.5, cpu_s=3.25, kept=7)


def test_rows_survive_a_cut_and_are_written_once(tmp_path: Path) -> None:
    results = Results(tmp_path / "rows.csv")
    results.add([PLAIN, REFINED])
    results.add([PLAIN, replace(PLAIN, frame="8")])
    again = Results(tmp_path / "rows.csv")
    assert again.rows == [PLAIN, REFINED, replace(PLAIN, frame="8")]
    case = Case(network="compact", frames="icl_nuim", points=None, outliers=0.2, seed=1, frame="7")
    assert again.has(case, "masked")
    assert not again.has(case, "masked, 40 steps")


def test_the_table_gives_changes_against_plain() -> None:
    worse = replace(REFINED, frame="8", mae=0.3, rmse=0.3, kept=0, cpu_s=0.75)
    lines = list(table([PLAIN, replace(PLAIN, frame="8"), REFINED, worse]))
    assert lines[-1] == (
        "| compact, icl_nuim, LiDAR, 20% wrong | 2 | masked | 0.2000 (+0.0%) | 0.4000 (+0.0%)"
        " | 2.0 | 4 | 50% |"
    )
