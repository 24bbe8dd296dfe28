"""`pnpdepth export` from the command line."""

from __future__ import annotations

import json
from pathlib import Path

from click.testing import CliRunner

from pnpdepth_cli.cli.export import export as command
from pnpdepth_cli.cli.main import cli
from tests.commands.test_export import project, results


def test_frames_are_counted_and_warnings_go_to_stderr(tmp_path: Path) -> None:
    folder = results(project(tmp_path, "OPENCV"))
    arguments = ["export", str(folder), "--to", "colmap", "-o", str(tmp_path / "dense")]
    result = CliRunner().invoke(cli, arguments)
    assert result.exit_code == 0, result.output
    assert result.stdout == f"wrote 3 frames in model units: {tmp_path / 'dense'}\n"
    assert "3 of 3 images have lens distortion" in result.stderr
    result = CliRunner().invoke(cli, [*arguments, "--overwrite", "--json"])
    record = json.loads(result.stdout)
    assert record == json.loads((tmp_path / "dense" / "export_colmap.json").read_text())


def test_every_export_is_explained_in_the_help() -> None:
    text = CliRunner().invoke(cli, ["export", "--help"]).stdout
    for name in next(each for each in command.params if each.name == "to").type.choices:  # type: ignore[attr-defined]
        assert f"  {name} " in text
