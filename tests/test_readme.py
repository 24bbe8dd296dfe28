"""README and docs: every command and every Python example runs, on a copy of the samples."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from safetensors.torch import save_file

from pnpdepth_cli.models.registry import find_definition

ROOT = Path(__file__).parent.parent
README = ROOT / "README.md"
PAGES = [README, *sorted((ROOT / "docs").rglob("*.md"))]
YOUR_NETWORK = ROOT / "docs" / "guides" / "your-network.md"
RECONSTRUCTION = ROOT / "docs" / "guides" / "reconstruction.md"
"""Its commands run in tests/test_reconstruction_guide.py, after the Python script of the page."""
WRITES_FILES = ("refine", "project", "sample", "simulate", "cloud")


def blocks(page: Path, language: str) -> list[str]:
    """The code blocks of a page in this language, with or without a title."""
    pattern = rf"^```{language}(?: [^\n]*)?\n(.*?)^```"
    return re.findall(pattern, page.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)


def shown_commands(page: Path) -> list[list[str]]:
    """The arguments of the `pnpdepth …` lines of the console blocks, continued lines joined."""
    lines = "\n".join(blocks(page, "console")).replace("\\\n", " ").splitlines()
    commands = (line.removeprefix("$ ").split("  #")[0] for line in lines)
    return [shlex.split(text.removeprefix("pnpdepth ")) for text in commands if text.strip()]


def titled_blocks(page: Path) -> dict[str, str]:
    """The files that a page shows, by their name."""
    text = page.read_text(encoding="utf-8")
    return dict(
        re.findall(r'^```(?:python|csv) title="([^"]+)"\n(.*?)^```', text, re.DOTALL | re.MULTILINE)
    )


def named(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with the samples, and the network of the guide with weights."""
    shutil.copytree(ROOT / "samples", tmp_path / "samples")
    (tmp_path / "my_net.py").write_text(titled_blocks(YOUR_NETWORK)["my_net.py"])
    network = find_definition(str(tmp_path / "my_net.py")).build()
    save_file(network.state_dict(), tmp_path / "my_net.safetensors")
    return tmp_path


def run(arguments: list[str], folder: Path, *path: str) -> str:
    """What the finished Python process printed. Fails with its stderr if it failed."""
    done = subprocess.run(
        [sys.executable, *arguments],
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), *path])},
        capture_output=True,
        text=True,
        check=False,
        cwd=folder,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def expanded(arguments: list[str], folder: Path) -> list[str]:
    """The arguments, those with a * as the shell hands them over."""
    found = list[str]()
    for each in arguments:
        paths = sorted(folder.glob(each.rstrip("/"))) if "*" in each else []
        found += [path.relative_to(folder).as_posix() for path in paths] or [each]
    return found


def test_the_readme_shows_the_main_commands() -> None:
    shown = {arguments[0] for arguments in shown_commands(README)}
    assert {"refine", "batch"} <= shown


WITH_COMMANDS = [page for page in PAGES if shown_commands(page) and page != RECONSTRUCTION]


@pytest.mark.slow
@pytest.mark.parametrize("page", WITH_COMMANDS, ids=named)
def test_the_commands_of_a_page_run(page: Path, folder: Path) -> None:
    for name, code in titled_blocks(page).items():
        (folder / name).write_text(code)
    for arguments in shown_commands(page):
        if arguments[0] == "python":
            run(arguments[1:], folder)
            continue
        overwrite = ["--overwrite"] if arguments[0] in WRITES_FILES else []
        run(["-m", "pnpdepth_cli", *expanded(arguments, folder), *overwrite], folder)


@pytest.mark.slow
@pytest.mark.parametrize("page", [README, ROOT / "docs" / "python-api.md"], ids=named)
def test_the_python_example_of_a_page_runs(page: Path, folder: Path) -> None:
    (code,) = [block for block in blocks(page, "python") if "import pnpdepth_cli as pnp" in block]
    assert run(["-c", code], folder)


def test_the_readme_is_short_and_its_example_has_ten_lines() -> None:
    assert len(README.read_text(encoding="utf-8").splitlines()) <= 140
    (code,) = [block for block in blocks(README, "python") if "import pnpdepth_cli as pnp" in block]
    assert len([line for line in code.splitlines() if line]) <= 10


@pytest.mark.parametrize("page", PAGES, ids=named)
def test_the_links_of_a_page_lead_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\(([^)#]+)(?:#[^)]*)?\)", page.read_text(encoding="utf-8")):
        assert target.startswith("http") or (page.parent / target).exists(), target


def test_the_commands_that_ci_runs_are_marked() -> None:
    text = README.read_text(encoding="utf-8")
    for name in ("main-job", "tests"):
        assert re.search(rf"<!-- {name} -->\n```sh\n.*\.venv/bin/", text)
