"""`pnpdepth cloud` from the command line: a cloud, one line on it, and a record."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from click.testing import CliRunner

from pnpdepth_cli.cli.main import cli
from pnpdepth_cli.io.depth import write_depth


def test_the_points_are_counted_and_the_camera_is_reported(tmp_path: Path) -> None:
    write_depth(tmp_path / "d.exr", np.full((24, 32), 2, np.float32))
    arguments = ["cloud", str(tmp_path / "d.exr"), "--fov", "60", "-o", str(tmp_path / "d.ply")]
    result = CliRunner().invoke(cli, arguments)
    assert result.exit_code == 0, result.output
    assert "wrote 768 points, without colours (no image is known)" in result.stdout
    assert "camera: 27.7 pixels of focal length" in result.stderr
    result = CliRunner().invoke(cli, [*arguments, "--overwrite", "--json"])
    assert json.loads(result.stdout)["points"] == 768


def test_the_default_edge_is_that_of_the_library() -> None:
    from pnpdepth_cli.cli.cloud import cloud
    from pnpdepth_cli.sensors.cloud import EDGE

    assert next(each for each in cloud.params if each.name == "edge").default == EDGE
