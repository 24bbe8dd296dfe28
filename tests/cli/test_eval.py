"""`pnpdepth eval`, and `compare` of what it prints, as a user has them."""

from __future__ import annotations

import csv
import io
import json
import os
import sys
from pathlib import Path

import numpy as np
import pytest

from pnpdepth_cli.cli.main import run
from pnpdepth_cli.io.depth import write_depth


def code_of(line: str) -> int:
    return run(line.split())


@pytest.fixture
def frames(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """out/ and gt/ of six frames, one with a strange name; the work goes on beside them."""
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(0)
    for folder in ("out", "gt"):
        Path(folder).mkdir()
    for name in ("a", "b ü_1", "c\nd", "e", "f", "g"):
        truth = rng.uniform(1, 9, (6, 8)).astype(np.float32)
        write_depth(Path("out", f"{name}.npy"), truth * np.float32(1.1))
        write_depth(Path("gt", f"{name}.npy"), truth)
    return tmp_path


def test_json_holds_what_all_options_give(frames: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options = "--protocol garg --max-depth 10 --scale-by median --delta 1.06 --json"
    assert code_of(f"eval out gt {options}") == 0
    record = json.loads(capsys.readouterr().out)
    assert record["scoring"]["max_depth"] == 10
    scores = record["frames"][0]["errors"]["ground_truth"]["after"]
    # predictions are 1.1 × too far
    assert (scores["factor"], record["mean"]["mre"]) == pytest.approx((1 / 1.1, 0), abs=1e-6)


def test_csv_has_a_line_for_each_frame_also_for_one_without_prediction(frames: Path) -> None:
    Path("out/a.npy").unlink()
    assert code_of("eval out gt --csv new/scores.csv") == 7
    text = Path("new/scores.csv").read_bytes().decode()
    a, b, c, *_ = csv.DictReader(io.StringIO(text, newline=""))
    assert (a["name"], a["rmse"], a["coverage"]) == ("a", "", "")
    assert a["error"]
    assert c["name"] == "c\nd"
    assert float(b["mre"]) == pytest.approx(0.1, rel=1e-5)


def test_csv_replaces_a_file_only_if_asked(frames: Path) -> None:
    assert code_of("eval out gt --csv new/scores.csv") == 0
    assert code_of("eval out gt --csv new/scores.csv") == 2
    assert code_of("eval out gt --csv new/scores.csv --overwrite") == 0


@pytest.mark.parametrize("file", ["gt/e.npy", "gt/e.npy/s.csv"])
def test_csv_never_replaces_an_input(file: str, frames: Path) -> None:
    assert code_of(f"eval out/e.npy gt/e.npy --csv {file} --overwrite") == 2
    assert np.load("gt/e.npy").shape == (6, 8)


@pytest.fixture
def far_frames(frames: Path) -> Path:
    """The same, ten times as far."""
    for path in frames.glob("*/*.npy"):
        np.save(path, 10 * np.load(path))
    return frames


def test_columns_choose_measures_and_their_order(
    far_frames: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert code_of("eval out gt --protocol kitti --columns delta1,rmse") == 0
    text = capsys.readouterr().out
    assert "MAE" not in text
    assert text.index("δ1") < text.index("RMSE")


def test_columns_of_a_comparison_are_those_of_its_latex_table_in_the_unit_of_the_protocol(
    far_frames: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert code_of("eval out gt --protocol kitti --json") == 0
    Path("a.json").write_text(capsys.readouterr().out)
    assert code_of("compare a.json a.json --columns delta1,rmse --latex -") == 0
    lines = capsys.readouterr().out.splitlines()
    assert "booktabs" in lines[1]
    assert lines[4] == r" & $\delta$1 $\uparrow$ & RMSE [mm] $\downarrow$ \\"
    name, delta, rmse = lines[6].removesuffix(r" \\").split(" & ")
    assert (name, delta) == ("a.json", r"\textbf{100.00\%}")
    assert float(rmse.removeprefix(r"\textbf{").removesuffix("}")) > 1000


@pytest.mark.skipif(sys.platform == "darwin", reason="file names are Unicode there")
def test_names_of_bytes_are_scored(frames: Path, capfdbinary: pytest.CaptureFixture[bytes]) -> None:
    for folder in ("out", "gt"):
        Path(folder, "a.npy").rename(Path(folder, os.fsdecode(b"\xff.npy")))
    for form in ("--json", "--csv -", "--columns rmse"):
        assert code_of(f"eval out gt {form}") == 0
    assert b"\\udcff" in capfdbinary.readouterr().out
