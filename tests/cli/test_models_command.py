"""`pnpdepth models` and its subcommands."""

from __future__ import annotations

import json

import pytest

from tests.cli.test_commands import code_of


def test_without_a_subcommand_the_networks_are_listed(capsys: pytest.CaptureFixture[str]) -> None:
    assert code_of(["models", "--json"]) == 0
    listed = json.loads(capsys.readouterr().out)
    assert code_of(["models", "list", "--json"]) == 0
    assert listed == json.loads(capsys.readouterr().out)
    assert "compact" in [model["name"] for model in listed]
    assert code_of(["models", "--check", "net.onnx"]) == 2
