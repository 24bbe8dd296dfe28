"""`pnpdepth eval` and `pnpdepth compare` as a user has them."""

from __future__ import annotations

import csv
import io
import json
import os
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pnpdepth_cli.cli.main import run
from pnpdepth_cli.io.depth import write_depth
from tests.commands.frames import frame_on_disk


def code_of(*arguments: str | Path) -> int:
    return run([str(argument) for argument in arguments])


def scores_of(record: dict[str, Any]) -> dict[str, Any]:
    """The scores of a frame's record in JSON."""
    scores: dict[str, Any] = record["errors"]["ground_truth"]["after"]
    return scores


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


def test_json_is_the_whole_result_with_every_option(
    frames: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = "--protocol garg --max-depth 10 --scale-by median --delta 1.06 --json"
    assert code_of("eval", "out", "gt", *options.split()) == 0
    record = json.loads(capsys.readouterr().out)
    assert record["scoring"]["max_depth"] == 10
    assert record["mean"]["mre"] == pytest.approx(0, abs=1e-6)  # predictions are 1.1 × too far
    assert scores_of(record["frames"][0])["factor"] == pytest.approx(1 / 1.1)


def test_csv_has_a_line_for_each_frame_and_replaces_nothing_unasked(frames: Path) -> None:
    Path("out/a.npy").unlink()
    assert code_of("eval", "out", "gt", "--csv", "scores.csv") == 7
    text = Path("scores.csv").read_bytes().decode()
    a, b, c, *_ = csv.DictReader(io.StringIO(text, newline=""))
    assert (a["name"], a["rmse"], a["coverage"]) == ("a", "", "")
    assert a["error"]
    assert c["name"] == "c\nd"
    assert float(b["mre"]) == pytest.approx(0.1, rel=1e-5)
    Path("scores.csv").write_text("mine")
    assert code_of("eval", "out", "gt", "--csv", "scores.csv") == 2
    assert Path("scores.csv").read_text() == "mine"
    assert code_of("eval", "out", "gt", "--csv", "scores.csv", "--overwrite") == 7
    before = Path("gt/e.npy").read_bytes()
    assert code_of("eval", "out/e.npy", "gt/e.npy", "--csv", "gt/e.npy", "--overwrite") == 2
    assert Path("gt/e.npy").read_bytes() == before
    assert code_of("eval", "out", "gt", "--csv", "gt/e.npy/s.csv") == 2
    assert code_of("eval", "out", "gt", "--csv", "new/s.csv") == 7
    assert Path("new/s.csv").is_file()


def test_columns_choose_measures_and_latex_has_no_thousands_separators(
    frames: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for path in frames.glob("*/*.npy"):
        np.save(path, 10 * np.load(path))
    assert code_of("eval", "out", "gt", "--protocol", "kitti", "--columns", "delta1,rmse") == 0
    text = capsys.readouterr().out
    assert "MAE" not in text
    assert text.index("δ1") < text.index("RMSE")
    assert code_of("eval", "out", "gt", "--protocol", "kitti", "--json") == 0
    Path("a.json").write_text(capsys.readouterr().out)
    assert code_of("compare", "a.json", "a.json", "--columns", "delta1,rmse", "--latex", "-") == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[3] == r" & $\delta$1 $\uparrow$ & RMSE [mm] $\downarrow$ \\"
    name, delta, rmse = lines[5].removesuffix(r" \\").split(" & ")
    assert (name, delta) == ("a.json", r"\textbf{100.00\%}")
    assert float(rmse.removeprefix(r"\textbf{").removesuffix("}")) > 1000


def test_a_refinement_scores_the_same_when_its_files_are_evaluated(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    frame, out = frame_on_disk(tmp_path), tmp_path / "out"
    network = ("--model", frame.model, "--checkpoint", frame.checkpoint)
    files = (frame.image, "--sparse", frame.sparse, "--gt", frame.gt, "-o", out)
    assert code_of("refine", *files, *network) == 0
    capsys.readouterr()
    (tmp_path / "gt").mkdir()
    (tmp_path / "gt" / "img.png").write_bytes(frame.gt.read_bytes())
    assert code_of("eval", out, tmp_path / "gt", "--json") == 0
    record = json.loads(capsys.readouterr().out)
    refined = json.loads((out / "img.json").read_text())
    # the depth was written as whole millimetres
    assert record["mean"]["mae"] == pytest.approx(scores_of(refined)["mae"], abs=1 / 1000)
    (scored,) = record["frames"]
    assert scored["inputs"]["image"]["path"] == str(frame.image)
    assert scores_of(scored)["given"] == 60


@pytest.mark.skipif(sys.platform == "darwin", reason="file names are Unicode there")
def test_a_name_that_is_no_utf_8_is_scored_and_printed(
    frames: Path, capfdbinary: pytest.CaptureFixture[bytes]
) -> None:
    for folder in ("out", "gt"):
        Path(folder, "a.npy").rename(Path(folder, os.fsdecode(b"\xff.npy")))
    for form in ("--json", "--csv -", "--columns rmse"):
        assert code_of("eval", "out", "gt", *form.split()) == 0
    assert b"\\udcff" in capfdbinary.readouterr().out
