from __future__ import annotations

from pathlib import Path

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
