from __future__ import annotations

import csv
import json
import re
from pathlib import Path
from typing import Any

import click
import pytest

from pnpdepth_cli.cli.sweep import sweep
from pnpdepth_cli.commands.sweep.axes import PARAMETERS
from tests.cli.test_commands import code_of


def arguments(*more: str, source: str = "drive") -> list[str]:
    return [
        "sweep", source, "-o", "out", "--model", "drive/net/my_net.py",
        "--checkpoint", "drive/net/my_net.safetensors", *more,
    ]  # fmt: skip


def test_a_sweep_prints_a_table_per_study_and_the_files_it_wrote(
    root: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    vary = ("--one-by-one", "--vary", "points=20,60", "--vary", "loss=l1,l2", "--seeds", "2")
    assert code_of(arguments(*vary)) == 0
    out, err = capsys.readouterr()
    titles = [line for line in out.splitlines() if "means over frames" in line]
    assert [title.split(":")[0] for title in titles] == ["points", "loss"]
    assert re.search(r"^ 20 +20 +2 +0\.\d{4}", out, re.MULTILINE)
    assert "points: the frames' own; --sample to change" in err
    assert "2 frames, 12 runs: 0 done already, 12 to do" in err
    last = err.splitlines()[-1]
    assert last.startswith("wrote out/sweep.csv")
    for written in last.removeprefix("wrote ").split():
        assert Path(written).stat().st_size > 0
    assert code_of(arguments(*vary)) == 0
    again, err = capsys.readouterr()
    assert again == out
    assert "12 done already, 0 to do" in err


def test_json_prints_what_is_in_the_file_and_the_csv_has_the_same_cells(
    root: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    vary = ("--vary", "iterations=0,2", "--vary", "update=sign,adam", "--plots", "none", "--json")
    assert code_of(arguments(*vary)) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed == json.loads(Path("out/sweep.json").read_text())
    with Path("out/sweep.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    cells = printed["studies"][0]["cells"]
    assert [[row["iterations"], row["update"]] for row in rows] == [
        list(cell["parameters"].values()) for cell in cells
    ]
    assert [float(row["rmse_gain"]) for row in rows] == [
        cell["measures"]["rmse"]["gain"] for cell in cells
    ]
    assert not list(Path("out").glob("*.png"))


def test_what_is_set_is_not_varied_and_is_recorded(
    root: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    fixed = ("lr=10%", "line-search=on", "noise=0.1", "seed=3", "points=20")
    options = [part for text in fixed for part in ("--set", text)]
    assert (
        code_of(arguments(*options, "--vary", "iterations=0,2", "--plots", "none", "--json")) == 0
    )
    record = json.loads(capsys.readouterr().out)
    base = record["base"]
    assert (base["lr"], base["line_search"], base["noise"]) == ("10%", True, 0.1)
    assert record["studies"][0]["parameters"] == {"iterations": ["0", "2"]}
    with Path("out/sweep_frames.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert {(row["seed"], row["points_used"]) for row in rows} == {("3", "20")}


def test_why_a_frame_failed_is_reported_once(
    root: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert code_of(arguments("--vary", "points=500", "--vary", "lr=1,2", "--plots", "none")) == 7
    *_, last = lines = capsys.readouterr().err.splitlines()
    assert "4 of 4 runs failed" in last
    assert [line for line in lines if line.startswith("failed")] == [
        f"failed: {name}: 500 points of 60; ask for fewer, or draw them from the ground"
        " truth with --sample 500"
        for name in ("a", "b")
    ]


def test_frames_without_truth_are_an_input_error(
    root: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for truth in (root / "gt").iterdir():
        truth.unlink()
    (root / "gt").rmdir()
    assert code_of(arguments("--vary", "lr=1")) == 3
    assert "none of its 2 frames has ground truth" in capsys.readouterr().err
    assert not Path("out").exists()


def test_ctrl_c_prints_how_to_continue_and_exits_130(
    root: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from pnpdepth_cli.commands.sweep import running as sweep_running

    own, calls = sweep_running.refine_frame, []

    def interrupted(*request: Any, **options: Any) -> object:
        calls.append(request)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return own(*request, **options)

    monkeypatch.setattr(sweep_running, "refine_frame", interrupted)
    vary = ("--vary", "lr=1%,3%", "--plots", "none")
    assert code_of(arguments(*vary)) == 130
    assert "stopped; run the same command to continue" in capsys.readouterr().err
    assert code_of(arguments(*vary)) == 0
    assert "4 runs: 1 done already, 3 to do" in capsys.readouterr().err


def test_the_help_names_all_that_can_be_varied() -> None:
    text = sweep.get_help(click.Context(sweep))
    paragraph = text[text.index("points      N") : text.index("One --vary")]
    assert set(PARAMETERS) <= set(re.findall(r"[a-z]+(?:-[a-z]+)?", paragraph))


@pytest.mark.slow
def test_the_sample_frames_give_a_table_and_a_plot(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    samples = Path(__file__).parents[2] / "samples/frames.csv"
    out = tmp_path / "sweep"
    options = ["--limit", "1", "--sample", "500", "--vary", "iterations=0,2"]
    assert code_of(["sweep", str(samples), "-o", str(out), *options, "--json"]) == 0
    first, second = json.loads(capsys.readouterr().out)["studies"][0]["cells"]
    assert first["measures"]["mae"]["refined"] == first["measures"]["mae"]["plain"]
    assert second["measures"]["mae"]["refined"] < second["measures"]["mae"]["plain"]
    assert second["measures"]["mae"]["plain"] < second["measures"]["mae"]["linear"]
    assert (out / "sweep_iterations.png").stat().st_size > 10_000
