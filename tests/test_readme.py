"""Every command that the README shows does what it says, on a copy of the samples."""

from __future__ import annotations

import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from safetensors.torch import save_file

from pnpdepth_cli.models.registry import find_definition
from pnpdepth_cli.pipeline.refinement.refine import refine_image
from pnpdepth_cli.pipeline.refinement.request import RefineRequest
from tests.pipeline.frames import frame_on_disk

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


def test_the_network_of_the_readme_is_refined(tmp_path: Path) -> None:
    (code,) = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)
    frame = frame_on_disk(tmp_path)
    (tmp_path / "my_net.py").write_text(code)
    network = find_definition(str(tmp_path / "my_net.py")).build()
    save_file(network.state_dict(), tmp_path / "my_net.safetensors")
    outcome = refine_image(
        RefineRequest.from_fields(
            image=frame.image,
            sparse=frame.sparse,
            model=str(tmp_path / "my_net.py"),
            checkpoint=tmp_path / "my_net.safetensors",
            output=tmp_path / "depth.npy",
        )
    )
    assert outcome.record["loss"][-1] < outcome.record["loss"][0]


def test_the_links_of_the_readme_lead_somewhere() -> None:
    for target in re.findall(r"\]\(([^)#]+)\)", README):
        assert target.startswith("http") or (ROOT / target).exists(), target
