"""A data set layout of another package is offered, guessed and read like one of ours."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

LAYOUT_MODULE = """
from pnpdepth_cli.io.dataset.frame import Frame, Listing
from pnpdepth_cli.io.layouts import Layout


def matches(root):
    return (root / "camera").is_dir()


def listing(root):
    images = sorted((root / "camera").glob("*.png"))
    return Listing(frames=[Frame(name=image.stem, image=image) for image in images])


LAYOUT = Layout(matches=matches, listing=listing)
"""

USE = """
import sys
from pathlib import Path
from pnpdepth_cli.cli.batch import batch
from pnpdepth_cli.io.layouts import find_layout, read_frames

root = Path(sys.argv[1])
assert find_layout(root) == "field-robot"
assert [frame.name for frame in read_frames(root, "field-robot")] == ["a", "b"]
option = next(each for each in batch.params if each.name == "layout")
assert option.type.choices[-1] == "field-robot", option.type.choices
"""


def test_a_layout_of_another_package_is_one_file_and_one_entry_point(tmp_path: Path) -> None:
    info = tmp_path / "site" / "other-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: other\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(
        "[pnpdepth.layouts]\nfield-robot = other_layout:LAYOUT\n"
    )
    (tmp_path / "site" / "other_layout.py").write_text(LAYOUT_MODULE)
    (tmp_path / "frames" / "camera").mkdir(parents=True)
    for name in "ba":
        (tmp_path / "frames" / "camera" / f"{name}.png").touch()
    path = os.pathsep.join([str(tmp_path / "site"), *sys.path])
    done = subprocess.run(
        [sys.executable, "-c", USE, str(tmp_path / "frames")],
        env={**os.environ, "PYTHONPATH": path},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
