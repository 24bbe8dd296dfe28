"""`pnpdepth export` as a user has it."""

from __future__ import annotations

from pathlib import Path

import pytest

from pnpdepth_cli.cli.main import run
from tests.commands.projects import project, results


def test_export_counts_frames_and_warns(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = results(project(tmp_path, "OPENCV"))
    dense = tmp_path / "dense"
    assert run(["export", str(folder), "--to", "colmap", "-o", str(dense)]) == 0
    out, err = capsys.readouterr()
    assert out == f"wrote 3 frames in model units: {dense}\n"
    assert " 3 of 3 images have lens distortion" in err
