"""A depth format and a layout of another package are offered and used like ours."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from pnpdepth_cli.choices import FORMATS
from pnpdepth_cli.io.formats import DEPTH_SUFFIXES

FORMAT = """
import numpy as np
from pnpdepth_cli.io.formats import DepthFormat, StoredArray

def read(path, data, channel):
    rows = [line.split() for line in data.decode().splitlines()[1:]]
    return StoredArray(values=np.array(rows, np.float32), description="table of metres")

def write(file, metres, options):
    lines = ["METRES", *(" ".join(map(repr, row)) for row in metres.tolist())]
    file.write_text("\\n".join(lines))

ENTRY = DepthFormat(
    name="METRES", suffixes=(".metres",), magic=(b"METRES",), read=read, write=write
)
"""

USE_FORMAT = """
import sys
from pathlib import Path
import numpy as np
from pnpdepth_cli.io.depth import read_depth, write_depth
from pnpdepth_cli.io.formats import DEPTH_SUFFIXES
from pnpdepth_cli.io.sparse_files import SPARSE_SUFFIXES
from pnpdepth_cli.cli.refine import refine

depth = np.array([[1.5, 0], [2.25, 80]], np.float32)
path = Path(sys.argv[1]) / "depth.metres"
write_depth(path, depth)
image = read_depth(path)
assert np.array_equal(image.values, depth), image
assert image.source == "table of metres", image
for suffixes in (DEPTH_SUFFIXES, SPARSE_SUFFIXES):
    assert ".metres" in suffixes, suffixes
option = next(each for each in refine.params if each.name == "format")
assert "metres" in option.type.choices, option.type.choices
"""

LAYOUT = """
from pnpdepth_cli.io.dataset import Frame
from pnpdepth_cli.io.layouts import Layout

def frames(root):
    for image in sorted((root / "camera").glob("*.png")):
        yield Frame(name=image.stem, image=image)

ENTRY = Layout(matches=lambda root: (root / "camera").is_dir(), frames=frames)
"""

USE_LAYOUT = """
import sys
from pathlib import Path
from pnpdepth_cli.cli.batch import batch
from pnpdepth_cli.io.layouts import find_layout, read_frames

root = Path(sys.argv[1])
(root / "camera").mkdir()
for name in "ba":
    (root / "camera" / f"{name}.png").touch()
assert find_layout(root) == "field-robot"
assert [frame.name for frame in read_frames(root, "field-robot")] == ["a", "b"]
option = next(each for each in batch.params if each.name == "layout")
assert option.type.choices[-1] == "field-robot", option.type.choices
"""


@pytest.mark.parametrize(
    ("entry", "module", "use"),
    [
        ("[pnpdepth.formats]\nmetres", FORMAT, USE_FORMAT),
        ("[pnpdepth.layouts]\nfield-robot", LAYOUT, USE_LAYOUT),
    ],
    ids=["format", "layout"],
)
def test_what_another_package_adds_is_one_file_and_one_entry_point(
    entry: str, module: str, use: str, tmp_path: Path
) -> None:
    info = tmp_path / "site" / "other-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: other\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(f"{entry} = other:ENTRY\n")
    (tmp_path / "site" / "other.py").write_text(module)
    (tmp_path / "files").mkdir()
    path = os.pathsep.join([str(tmp_path / "site"), *sys.path])
    done = subprocess.run(
        [sys.executable, "-c", use, str(tmp_path / "files")],
        env={**os.environ, "PYTHONPATH": path},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr


def test_every_format_has_a_file_name_made_of_its_own_name() -> None:
    for name, depth_format in FORMATS.items():
        assert f".{name}" in depth_format.suffixes
        assert set(depth_format.suffixes) <= set(DEPTH_SUFFIXES)
