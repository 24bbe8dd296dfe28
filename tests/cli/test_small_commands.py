"""`cloud`, `export`, `models` and `doctor` from the command line."""

from __future__ import annotations

import re
from importlib import metadata
from pathlib import Path

import numpy as np
import pytest
import torch
from click.testing import CliRunner

from pnpdepth_cli.cli.main import cli, run
from pnpdepth_cli.commands import doctor
from pnpdepth_cli.io.depth import write_depth
from tests.commands.test_export import project, results


def test_the_points_of_a_cloud_are_counted_and_the_camera_is_reported(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_depth(tmp_path / "d.exr", np.full((24, 32), 2, np.float32))
    (tmp_path / "k.txt").write_text("30 0 16 0 30 12 0 0 1")
    arguments = ["cloud", str(tmp_path / "d.exr"), "--calib", str(tmp_path / "k.txt")]
    arguments += ["-o", str(tmp_path / "d.ply")]
    assert run(arguments) == 0
    out, err = capsys.readouterr()
    assert "wrote 768 points, without colours (no image is known)" in out
    assert err == ""


def test_exported_frames_are_counted_and_warnings_go_to_stderr(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = results(project(tmp_path, "OPENCV"))
    arguments = ["export", str(folder), "--to", "colmap", "-o", str(tmp_path / "dense")]
    assert run(arguments) == 0
    out, err = capsys.readouterr()
    assert out == f"wrote 3 frames in model units: {tmp_path / 'dense'}\n"
    assert " 3 of 3 images have lens distortion" in err


def test_networks_are_listed(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["models"]) == 0
    out = capsys.readouterr().out
    assert {"sparse2dense-kitti", "sparse2dense-tiny"} <= set(out.split())
    assert run(["models", "--check", "net.onnx"]) == 2


def test_doctor_reports_versions_devices_extras_and_a_refined_plane() -> None:
    result = CliRunner().invoke(cli, ["doctor"])
    assert result.exit_code == 0, result.output
    lines = result.stdout.splitlines()
    assert lines[0].split() == ["pnpdepth", metadata.version("pnpdepth")]
    assert any(f"torch {metadata.version('torch')}" in line for line in lines)
    assert any(f"cpu: {torch.get_num_threads()} threads" in line for line in lines)
    assert any(line[12:].startswith("onnx ") for line in lines)
    assert not any(line[12:].startswith("pytest ") for line in lines)
    plane = r"self-test +passed; a plane refined in [\d.]+ s, MAE ([\d.]+) m"
    (error,) = filter(None, (re.fullmatch(plane, line) for line in lines))
    assert float(error[1]) < 0.02


def test_doctor_names_what_is_missing_and_fails_with_the_self_test(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    required = ["torch>=2.4", "none-such>=1"]
    extras = ['no-such-package>=1; extra == "plot"', 'pytest; extra == "test"']
    monkeypatch.setattr(metadata, "requires", lambda _: [*required, *extras])
    monkeypatch.setattr(doctor, "_self_test", lambda: "FAILED: the depth is wrong")
    report = doctor.examine()
    assert report["packages"] == [
        f"torch {metadata.version('torch')}",
        "none-such not installed",
        "no-such-package not installed, of the extra plot",
    ]
    result = CliRunner().invoke(cli, ["doctor"])
    assert result.exit_code == 1
    assert "self-test   FAILED: the depth is wrong" in result.output
