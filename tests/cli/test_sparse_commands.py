from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from tests.cli.test_commands import code_of
from tests.commands.frames import frame_on_disk
from tests.commands.scan_frames import ScanOnDisk, scan_on_disk


@pytest.fixture
def frame(tmp_path: Path) -> ScanOnDisk:
    return scan_on_disk(tmp_path)


def test_project_reports_dropped_points_and_written_files(
    frame: ScanOnDisk, capsys: pytest.CaptureFixture[str]
) -> None:
    sparse = frame.folder / "sparse.png"
    arguments = ["project", str(frame.scan), "--calib", str(frame.calib), "-o", str(sparse)]
    assert code_of([*arguments, "--image", str(frame.image), "--scan", "max-range=4.8"]) == 0
    out, err = capsys.readouterr()
    assert out == ""
    assert "KITTI scan of 150 points" in err
    assert "out of range" in err
    assert "sparse.png" in err
    assert code_of([*arguments, "--size", "48x64", "--overwrite", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["points"]["count"] == 150


def test_sample_takes_a_number_or_a_share(
    frame: ScanOnDisk, capsys: pytest.CaptureFixture[str]
) -> None:
    output = ["-o", str(frame.folder / "s.csv"), "--json", "--overwrite", "--seed", "3"]
    arguments = ["sample", str(frame.gt), *output]
    for count, points in (("40", 40), ("25%", 768)):
        assert code_of([*arguments, "--count", count]) == 0
        record = json.loads(capsys.readouterr().out)
        assert (record["points"]["count"], record["seed"]) == (points, 3)
    assert code_of([*arguments, "--pattern", "region:1,2,3,4"]) == 0
    assert json.loads(capsys.readouterr().out)["points"]["count"] == 12
    for wrong in (["--count", "many"], ["--pattern", "region:1,2,3"]):
        assert code_of([*arguments, *wrong]) == 2


def test_simulate_writes_the_sensors_points(
    frame: ScanOnDisk, capsys: pytest.CaptureFixture[str]
) -> None:
    output = ["-o", str(frame.folder / "s.exr"), "--seed", "1", "--position", "0,-0.1,0"]
    arguments = ["simulate", str(frame.gt), "--calib", str(frame.calib), *output]
    assert code_of([*arguments, "--sensor", "hdl-64e"]) == 0
    assert "hdl-64e, seed 1" in capsys.readouterr().err
    assert code_of([*arguments, "--overwrite", "--sensor", "hdl-65e"]) == 2
    assert "hdl-64e" in capsys.readouterr().err


def test_refine_takes_a_scan_with_its_calibration(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    network = frame_on_disk(tmp_path)
    (tmp_path / "scan").mkdir()
    scan = scan_on_disk(tmp_path / "scan")
    arguments = [
        "refine", str(scan.image), "--sparse", str(scan.scan), "-o", str(tmp_path / "out"),
        "--model", str(network.model), "--checkpoint", str(network.checkpoint), "--json",
    ]  # fmt: skip
    assert code_of([*arguments, "--calib", str(scan.calib), "--gt", str(scan.gt)]) == 0
    record = json.loads(capsys.readouterr().out)
    assert record["points"]["used"] == 150
    assert record["inputs"]["sparse"]["dropped"]["hidden by foreground"] == 0
    assert record["sparse_error"]["after"]["mae"] < record["sparse_error"]["before"]["mae"]


def test_max_pixels_refuses_and_allows_an_image_by_its_size(
    frame: ScanOnDisk, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["sample", str(frame.gt), "--count", "5", "-o", str(frame.folder / "few.png")]
    assert code_of(["--max-pixels", "10", *arguments]) == 3
    assert "pixels, more than 10; make it smaller" in capsys.readouterr().err
    assert code_of(arguments) == 0


def test_point_fields_sets_how_the_points_of_a_scan_are_stored(
    frame: ScanOnDisk, capsys: pytest.CaptureFixture[str]
) -> None:
    scan = np.fromfile(frame.scan, "<f4").reshape(-1, 4)
    wide = frame.folder / "wide.bin"
    np.column_stack([scan, scan[:, :2]]).astype("<f4").tofile(wide)
    arguments = ["project", str(wide), "--calib", str(frame.calib), "--image", str(frame.image)]
    arguments += ["-o", str(frame.folder / "sparse.png"), "--scan"]
    assert code_of([*arguments, "point-fields=6"]) == 0
    assert "scan of 6 fields a point" in capsys.readouterr().err
    assert json.loads((frame.folder / "sparse.json").read_text())["point_fields"] == 6
