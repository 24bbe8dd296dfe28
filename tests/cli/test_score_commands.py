"""`pnpdepth eval` and `pnpdepth compare` as a user has them."""

from __future__ import annotations

import csv
import io
import json
import os
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from pnpdepth_cli.cli.main import run
from pnpdepth_cli.io.depth import write_depth
from pnpdepth_cli.measures import MEASURES
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
    for name in ("a", "b ü_1", "c\nd", "e", "f", "g"):
        truth = rng.uniform(1, 9, (6, 8)).astype(np.float32)
        for folder, depth in (("out", truth * 1.1), ("better", truth * 1.05), ("gt", truth)):
            Path(folder).mkdir(exist_ok=True)
            write_depth(Path(folder) / f"{name}.npy", depth.astype(np.float32))
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


def test_csv_has_a_line_for_each_frame_also_those_without_score(frames: Path) -> None:
    Path("out/a.npy").unlink()
    assert code_of("eval", "out", "gt", "--csv", "scores.csv") == 7
    text = Path("scores.csv").read_bytes().decode()
    a, b, c, *_ = csv.DictReader(io.StringIO(text, newline=""))
    assert (a["name"], a["rmse"], a["coverage"], a["error"]) == (
        "a", "", "0.0", "there is no prediction",
    )  # fmt: skip
    assert c["name"] == "c\nd"
    assert float(b["mre"]) == pytest.approx(0.1, rel=1e-5)


def test_columns_choose_measures_and_latex_has_no_thousands_separators(
    frames: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = ("--protocol", "kitti", "--columns", "delta1,rmse")
    for folder in ("out", "gt"):
        for path in Path(folder).glob("*.npy"):
            np.save(path, 10 * np.load(path))
    assert code_of("eval", "out", "gt", *options, "--latex", "-") == 0
    first, second = (line.split(" & ") for line in capsys.readouterr().out.splitlines()[5:7])
    assert (first[0], first[1]) == (r"$\delta$1 $\uparrow$", r"100.00\%")
    assert second[0] == r"RMSE [mm] $\downarrow$"
    assert float(second[1]) > 1000
    assert code_of("eval", "out", "gt", *options) == 0
    text = capsys.readouterr().out
    assert "MAE" not in text
    assert text.index("δ1") < text.index("RMSE")


def test_tables_carry_a_scale_that_was_assumed(
    frames: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cv2.imwrite("gt.png", np.full((2, 3), 512, np.uint16))
    np.save("two.npy", np.full((2, 3), 2, np.float32))
    assert code_of("eval", "two.npy", "gt.png", "--latex", "-") == 0
    assert "; gt: 16-bit PNG ÷ 256, assumed" in capsys.readouterr().out.splitlines()[0]


def test_files_are_not_overwritten_unasked_and_inputs_never(
    frames: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    Path("s.csv").write_text("mine")
    assert code_of("eval", "out", "gt", "--csv", "s.csv") == 2
    assert "--overwrite replaces it" in capsys.readouterr().err
    assert Path("s.csv").read_text() == "mine"
    assert code_of("eval", "out", "gt", "--csv", "s.csv", "--overwrite") == 0
    before = Path("gt/a.npy").read_bytes()
    assert code_of("eval", "out/a.npy", "gt/a.npy", "--csv", "gt/a.npy", "--overwrite") == 2
    assert Path("gt/a.npy").read_bytes() == before
    assert code_of("eval", "out", "gt", "--csv", "nowhere/s.csv") == 2


def test_four_runs_fit_into_120_columns(frames: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert code_of("eval", "out", "gt", "--json") == 0
    text = capsys.readouterr().out
    runs = [f"{kind} run of a network with a long name at K = 20.json" for kind in "abcd"]
    for name in runs:
        Path(name).write_text(text)
    assert code_of("compare", *runs, "--columns", ",".join(m.key for m in MEASURES)) == 0
    out = capsys.readouterr().out
    rows = [line for line in out.splitlines() if "↓" in line or "↑" in line]
    assert len(rows) == 4 * len(MEASURES)
    assert max(map(len, out.splitlines())) <= 120
    assert all("…" in row and "long name at K = 20" in row for row in rows)


def test_a_refinement_scores_the_same_when_its_files_are_evaluated(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    frame = frame_on_disk(tmp_path)
    out = tmp_path / "out"
    assert code_of(
        "refine", frame.image, "--sparse", frame.sparse, "--gt", frame.gt, "-o", out,
        "--model", frame.model, "--checkpoint", frame.checkpoint,
    ) == 0  # fmt: skip
    capsys.readouterr()
    (tmp_path / "gt").mkdir()
    (tmp_path / "gt" / "img.png").write_bytes(frame.gt.read_bytes())
    assert code_of("eval", out, tmp_path / "gt", "--json") == 0
    text, err = capsys.readouterr()
    record, refined = json.loads(text), json.loads((out / "img.json").read_text())
    code = 1 / 1000  # the depth was written as whole millimetres
    assert record["mean"]["mae"] == pytest.approx(scores_of(refined)["mae"], abs=code)
    (scored,) = record["frames"]
    assert scored["inputs"]["image"]["path"] == str(frame.image)
    assert scores_of(scored)["given"] == 60
    assert "60 of the scored pixels (2.10%) have a point of the sparse input" in err


@pytest.mark.skipif(sys.platform == "darwin", reason="file names are Unicode there")
def test_a_name_that_is_no_utf_8_is_scored_and_printed(
    frames: Path, capfdbinary: pytest.CaptureFixture[bytes]
) -> None:
    for folder in ("out", "gt"):
        Path(folder, "a.npy").rename(Path(folder, os.fsdecode(b"\xff.npy")))
    for form in ("--json", "--csv", "--latex"):
        arguments = ["eval", "out", "gt", form, *(["-"] if form != "--json" else [])]
        assert code_of(*arguments) == 0
    assert code_of("eval", "out", "gt") == 0
    out = capfdbinary.readouterr().out
    assert b"\\udcff" in out
    assert rb"c\nd" in out


def test_an_evaluation_replaces_a_report_only_if_asked(
    root: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ("eval", "drive/gt", "drive/gt", "--html")
    assert code_of(*arguments, "scores") == 0
    before = Path("scores/index.html").stat().st_mtime_ns
    capsys.readouterr()
    assert code_of(*arguments, "scores") == 2
    assert capsys.readouterr().err == (
        "pnpdepth: scores is not empty; --overwrite replaces the report in it, or name another"
        " folder\n"
    )
    assert Path("scores/index.html").stat().st_mtime_ns == before
    assert code_of(*arguments, "drive/net/my_net.py/report") == 2
    assert code_of(*arguments, "scores", "--overwrite") == 0
    assert Path("scores/index.html").stat().st_mtime_ns > before
