"""Commands on the samples: exit code, names of the files, and a figure or two.

The errors are of the project's own weights, so they move only with the method; the tolerance is far
above what another processor changes.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from pnpdepth_cli.cli.main import run
from pnpdepth_cli.io.depth import read_depth

SAMPLES = Path(__file__).parents[2] / "samples"
INDOOR = f"refine {SAMPLES}/indoor/rgb.png --sparse {SAMPLES}/indoor/sparse.png"
FILES = {"rgb.json", "rgb_depth.png", "rgb_improvement.png", "rgb_preview.png"}
SIGMA = {"rgb_sigma.png", "rgb_valid.png"}
STREET = f"{SAMPLES}/street"


@pytest.fixture(autouse=True)
def _folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def output(capsys: pytest.CaptureFixture[str], line: str) -> str:
    assert run(line.split()) == 0
    return capsys.readouterr().out


def result(capsys: pytest.CaptureFixture[str], line: str) -> Any:
    return json.loads(output(capsys, f"{line} --json"))


@pytest.mark.parametrize(
    ("options", "before", "after", "more"),
    [
        ("", 0.075, 0.070, set()),
        ("--model sparse2dense-tiny", 0.451, 0.070, set()),
        ("--model fcrn-tiny --uncertainty", 1.041, 0.070, SIGMA),
        ("--model fcrn-tiny --method alone --propagate none", 1.056, 0.894, set()),
        ("--model fcrn-tiny --method paper", 1.386, 1.317, set()),
        (f"--depth {SAMPLES}/indoor/predicted.npy", 0.120, 0.030, set()),
    ],
)
def test_refine_writes_its_files_and_lowers_the_error(
    options: str, before: float, after: float, more: set[str], capsys: pytest.CaptureFixture[str]
) -> None:
    record = result(capsys, f"{INDOOR} --gt {SAMPLES}/indoor/gt.png -o out {options}")
    assert {path.name for path in Path("out").iterdir()} == FILES | more
    mae = [record["errors"]["ground_truth"][stage]["mae"] for stage in ("before", "after")]
    assert mae == pytest.approx([before, after], rel=0.02)


def test_unsupported_depth_is_said_and_zero_if_asked(capsys: pytest.CaptureFixture[str]) -> None:
    scan = f"{STREET}/rgb.png --sparse {STREET}/000000.bin --calib {STREET}/calib.txt"
    scan += " --iterations 1"
    line = f"refine {scan} --gt {STREET}/gt.png --uncertainty"
    kept, zero = (result(capsys, f"{line} --unknown {how} -o {how}") for how in ("keep", "zero"))
    depth, truth = (
        read_depth(path).values for path in (Path("zero/rgb_depth.png"), Path(STREET, "gt.png"))
    )
    valid = cv2.imread("zero/rgb_valid.png", cv2.IMREAD_GRAYSCALE) > 0
    whole = read_depth(Path("keep/rgb_depth.png")).values
    assert (depth == np.where(valid, whole, 0)).all()
    # The errors of all stages are those of the pixels whose depth is kept.
    errors = zero["errors"]["ground_truth"]
    known = (truth > 0) & valid
    assert errors["after"]["mae"] == pytest.approx(np.abs(depth - truth)[known].mean(), abs=0.01)
    assert errors["after"]["coverage"] == pytest.approx(known.sum() / (truth > 0).sum())
    assert errors["linear"]["mae"] < kept["errors"]["ground_truth"]["linear"]["mae"]
    assert (
        f"of {known.sum():,} pixels improved" in zero["result"]["figures"]["improvement"]["footer"]
    )
    # Without a mask, a note gives the part that lies outside of the scan.
    plain = result(capsys, f"refine {scan}")
    assert {*plain["result"]["outputs"]} == {"depth", "preview", "improvement", "record"}
    assert any("--unknown zero" in note for note in plain["notes"])
    assert plain["result"]["points"]["used"] == pytest.approx(16007, abs=5)


def test_a_batch_is_done_once_then_scored_and_compared(capsys: pytest.CaptureFixture[str]) -> None:
    line = f"batch {SAMPLES}/frames.csv -o out --model fcrn-tiny --method paper"
    output(capsys, line)
    frames = json.loads(Path("out/summary.json").read_text())["frames"]
    mae = {frame["name"]: frame["errors"]["ground_truth"]["after"]["mae"] for frame in frames}
    assert mae == pytest.approx({"indoor": 1.317, "street": 11.92}, rel=0.02)
    names = {path.name for path in Path("out").iterdir() if not path.name.startswith(".")}
    ends = (".json", "_depth.png", "_improvement.png", "_preview.png")
    expected = {name + end for name in ("indoor", "street") for end in ends}
    assert names == expected | {"summary.csv", "summary.json"}
    before = Path("out/indoor_depth.png").stat().st_mtime_ns
    output(capsys, line)
    assert Path("out/indoor_depth.png").stat().st_mtime_ns == before

    scored = result(capsys, f"eval out/indoor_depth.png {SAMPLES}/indoor/gt.png")
    assert scored["mean"]["mae"] == pytest.approx(mae["indoor"], rel=1e-3)
    table = output(capsys, "compare out/summary.json out/summary.json --csv table.csv")
    assert "MAE" in table
    rows = [row.split(",") for row in Path("table.csv").read_text().splitlines()]
    assert rows[0][:4] == ["measure", "run", "mean", "percent"]
    assert [row[3] for row in rows if row[0] == "mae"] == ["", "0.0"]

    Path("k.txt").write_text("554 0 320 0 554 240 0 0 1")
    told = output(capsys, "cloud out/indoor_depth.png --calib k.txt -o cloud.ply")
    assert "307,200 points, coloured" in told


@pytest.mark.parametrize(
    ("line", "count"),
    [
        (f"project {STREET}/000000.bin --calib {STREET}/calib.txt --image {STREET}/rgb.png", 16007),
        (f"sample {SAMPLES}/indoor/gt.png --count 100", 100),
        (f"simulate {SAMPLES}/indoor/gt.png --sensor vlp-16 --calib {STREET}/calib.txt", 3052),
    ],
    ids=["project", "sample", "simulate"],
)
def test_made_points_are_counted(line: str, count: int, capsys: pytest.CaptureFixture[str]) -> None:
    output(capsys, f"{line} -o sparse.png")
    record = json.loads(Path("sparse.json").read_text())
    assert record["points"]["count"] == pytest.approx(count, rel=1e-3)
    assert {"sparse.png", "sparse.json"} <= {path.name for path in Path().iterdir()}
