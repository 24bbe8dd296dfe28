"""Every command that the README shows does what it says, on a copy of the samples."""

from __future__ import annotations

import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text()


def shown_commands() -> list[str]:
    """The `pnpdepth …` lines of the console blocks, continued lines joined."""
    blocks = re.findall(r"```console\n(.*?)```", README, flags=re.DOTALL)
    lines = "\n".join(blocks).replace("\\\n", " ").splitlines()
    return [line.removeprefix("$ ").split("  #")[0] for line in lines if "pnpdepth " in line]


def arguments(command: str) -> list[str]:
    return shlex.split(command.partition("pnpdepth ")[2])


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("readme")
    shutil.copytree(ROOT / "samples", folder / "samples")
    return folder


def test_the_readme_shows_the_main_commands() -> None:
    shown = {arguments(command)[0] for command in shown_commands()}
    assert {"refine", "models", "layers"} <= shown


@pytest.mark.parametrize("command", shown_commands())
def test_a_command_of_the_readme_runs(command: str, folder: Path) -> None:
    code = "from pnpdepth_cli.cli.main import main; main()"
    done = subprocess.run(
        [sys.executable, "-c", code, *arguments(command), *overwrite(command)],
        capture_output=True,
        text=True,
        check=False,
        cwd=folder,
    )
    assert done.returncode == 0, done.stderr


def overwrite(command: str) -> list[str]:
    writes = arguments(command)[0] in ("refine", "project", "sample", "simulate")
    return ["--overwrite"] if writes else []


def test_the_links_of_the_readme_lead_somewhere() -> None:
    for target in re.findall(r"\]\(([^)#]+)\)", README):
        assert target.startswith("http") or (ROOT / target).exists(), target
