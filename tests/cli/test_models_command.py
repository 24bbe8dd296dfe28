"""`pnpdepth models`: its subcommands, and the flags they replace."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file

from pnpdepth_cli.cli.models import _with_subcommand
from tests.cli.test_commands import code_of


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ([], ["list"]),
        (["--all", "--json"], ["list", "--all", "--json"]),
        (["--check", "n.onnx", "--json"], ["check", "--json", "--", "n.onnx"]),
        (["--json", "--check=n.onnx"], ["check", "--json", "--", "n.onnx"]),
        (["--convert", "a", "b", "--overwrite"], ["convert", "--overwrite", "--", "a", "b"]),
        (["--fetch", "o/n", "-o", "n"], ["fetch", "-o", "n", "--", "o/n"]),
        (["check", "n.onnx"], ["check", "n.onnx"]),
        (["--help"], ["--help"]),
    ],
)
def test_the_old_flags_name_subcommands(old: list[str], new: list[str]) -> None:
    assert _with_subcommand(old) == new


def test_an_old_flag_works_and_names_the_new_form(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    torch.save({"w": torch.ones(2)}, tmp_path / "a.pt")
    target = tmp_path / "a.safetensors"
    assert code_of(["models", "--convert", str(tmp_path / "a.pt"), str(target)]) == 0
    assert "is now `models convert`" in capsys.readouterr().err
    assert load_file(target)["w"].tolist() == [1, 1]
    assert code_of(["models", "convert", str(tmp_path / "a.pt"), str(target), "--overwrite"]) == 0
    assert "is now" not in capsys.readouterr().err


def test_two_old_flags_at_once_are_refused() -> None:
    assert code_of(["models", "--check", "a", "--convert", "b", "c"]) == 2
