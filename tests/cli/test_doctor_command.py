"""`pnpdepth doctor`."""

from __future__ import annotations

import json
import re
from importlib import metadata

import pytest
import torch
from click.testing import CliRunner

from pnpdepth_cli.cli.doctor import doctor
from pnpdepth_cli.commands import doctor as commands_doctor


def test_the_report_has_versions_devices_extras_and_a_refined_plane() -> None:
    result = CliRunner().invoke(doctor, ["--json"])
    assert result.exit_code == 0, result.output
    report = json.loads(result.stdout)
    assert report["pnpdepth"] == metadata.version("pnpdepth")
    assert f"torch {metadata.version('torch')}" in report["packages"]
    assert report["devices"][0].startswith(f"cpu: {torch.get_num_threads()} threads")
    assert any(line.startswith("onnx: ") for line in report["extras"])
    assert not any(line.startswith("test: ") for line in report["extras"])
    error = re.fullmatch(
        r"passed; a plane refined in [\d.]+ s, MAE ([\d.]+) m", report["self-test"]
    )
    assert error is not None
    assert float(error[1]) < 0.02


def test_a_missing_extra_is_named_with_its_packages(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        metadata,
        "requires",
        lambda _: ["torch>=2.4", 'no-such-package>=1; extra == "plot"', 'pytest; extra == "test"'],
    )
    report = commands_doctor.examine()
    assert report["packages"] == [f"torch {metadata.version('torch')}"]
    assert report["extras"] == ["plot: not installed (no-such-package)"]


def test_a_self_test_that_fails_ends_with_code_1(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(commands_doctor, "_self_test", lambda: "FAILED: the depth is wrong")
    result = CliRunner().invoke(doctor)
    assert result.exit_code == 1
    assert "self-test   FAILED: the depth is wrong" in result.output
