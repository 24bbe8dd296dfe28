from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from pnpdepth_cli.cli.main import run
from tests.commands.scan_frames import ScanOnDisk, scan_on_disk


@pytest.fixture
def frame(tmp_path: Path) -> ScanOnDisk:
    return scan_on_disk(tmp_path)


def test_max_pixels_refuses_and_allows_an_image_by_its_size(
    frame: ScanOnDisk, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["sample", str(frame.gt), "--count", "5", "-o", str(frame.folder / "few.png")]
    assert run(["--max-pixels", "10", *arguments]) == 3
    assert "pixels, more than 10; make it smaller" in capsys.readouterr().err
    assert run(arguments) == 0


def test_point_fields_sets_how_the_points_of_a_scan_are_stored(
    frame: ScanOnDisk, capsys: pytest.CaptureFixture[str]
) -> None:
    scan = np.fromfile(frame.scan, "<f4").reshape(-1, 4)
    wide = frame.folder / "wide.bin"
    np.column_stack([scan, scan[:, :2]]).astype("<f4").tofile(wide)
    arguments = ["project", str(wide), "--calib", str(frame.calib), "--image", str(frame.image)]
    arguments += ["-o", str(frame.folder / "sparse.png"), "--scan"]
    assert run([*arguments, "point-fields=6"]) == 0
    assert "scan of 6 fields a point" in capsys.readouterr().err
    assert json.loads((frame.folder / "sparse.json").read_text())["point_fields"] == 6
