from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.frames import EvalFrame
from benchmarks.paper_figures import ROWS, PaperRow
from benchmarks.paper_report import bars_of, markdown
from benchmarks.paper_sets import FrameSet
from benchmarks.paper_tables import entries_of, scores_of, table_of


@pytest.mark.parametrize("row", ROWS, ids=lambda row: f"{row.name}-{row.street}")
def test_the_papers_figures_give_the_gains_printed_beside_them(row: PaperRow) -> None:
    for measure, printed in enumerate(row.gains):
        gain = 100 * (1 - row.after[measure] / row.before[measure])
        assert gain == pytest.approx(printed, abs=0.12)  # four decimals are printed of the errors
    assert not row.street or not row.takes("sparse2dense-tiny")  # for rooms


def test_all_depths_are_scored_on_the_same_pixels() -> None:
    gt = np.array([[2.0, 2.0, 2.0, 0.0]], np.float32)
    before = np.array([[2.0, 2.2, 9.0, 9.0]], np.float32)
    after = np.array([[2.0, 2.0, -1.0, 9.0]], np.float32)
    scores, coverage = scores_of({"before": before, "after": after}, gt)
    measured = [scores["before"][key] for key in ("mae", "delta1", "fine1")]
    assert [*measured, scores["after"]["mae"]] == pytest.approx([0.1, 100, 50, 0])
    assert coverage == pytest.approx(2 / 3)


def test_the_table_has_a_row_for_each_network_that_takes_the_points(tmp_path: Path) -> None:
    wall = np.full((100, 400), 15.0, np.float32)
    scan = np.zeros_like(wall)
    scan[20::2, ::2] = 15.0
    image = np.zeros((100, 400, 3), np.float32)
    entries = entries_of(["sparseconv-tiny", "adnn-tiny"])[0]
    tables = [
        table_of(FrameSet("walls", True, 1, lambda frame=frame: iter([frame])), entries)
        for frame in (EvalFrame("", image, wall, scan), EvalFrame("", image, wall))
    ]
    rows = [[(row["network"], row["points"]) for row in table["rows"]] for table in tables]
    assert rows == [[("sparseconv-tiny", 40 * 200), ("adnn-tiny", 40 * 200)], []]
    assert len(bars_of(tables[0])["published"]) == 2
    assert all(row["std_z"] > 0 and row["frames"] == 1 for row in tables[0]["rows"])
    assert "*Chodosh, published*" in markdown(tables[0])
    assert "`adnn-tiny` needs a LiDAR and a ground truth besides it" in tables[1]["notes"][1]
