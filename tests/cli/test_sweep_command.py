from __future__ import annotations

import csv
import json
import re
from pathlib import Path
from typing import Any

import click
import pytest

from pnpdepth_cli.cli.main import run
from pnpdepth_cli.cli.sweep import sweep
from pnpdepth_cli.commands.sweep.axes import PARAMETERS


def arguments(*more: str, source: str = "drive") -> list[str]:
    return [
        "sweep", source, "-o", "out", "--model", "drive/net/my_net.py",
        "--checkpoint", "drive/net/my_net.safetensors", *more,
    ]  # fmt: skip


def test_what_is_set_is_not_varied_and_is_recorded(
    root: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    fixed = ("lr=10%", "line-search=on", "noise=0.1", "seed=3", "points=20")
    options = [part for text in fixed for part in ("--set", text)]
    assert run(arguments(*options, "--vary", "iterations=0,2", "--plots", "none", "--json")) == 0
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
    assert run(arguments("--vary", "points=500", "--vary", "lr=1,2", "--plots", "none")) == 7
    *_, last = lines = capsys.readouterr().err.splitlines()
    assert " 4 of 4 runs failed" in last
    assert [line for line in lines if line.startswith("failed")] == [
        f"failed: {name}: 500 points of 60; ask for fewer, or draw them from the ground"
        " truth with --sample 500"
        for name in ("a", "b")
    ]


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
    assert run(arguments(*vary)) == 130
    assert "stopped; run the same command to continue" in capsys.readouterr().err
    assert run(arguments(*vary)) == 0
    assert " 4 runs: 1 done already, 3 to do" in capsys.readouterr().err


def test_the_help_names_all_that_can_be_varied() -> None:
    text = sweep.get_help(click.Context(sweep))
    paragraph = text[text.index("points      N") : text.index("One --vary")]
    assert set(PARAMETERS) <= set(re.findall(r"[a-z]+(?:-[a-z]+)?", paragraph))
