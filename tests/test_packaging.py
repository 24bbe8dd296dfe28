"""The wheel holds every package of the source tree, and the package runs as the command."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path
from typing import Any

import pytest

import pnpdepth_cli as pnp
from pnpdepth_cli.io.depth import read_depth

ROOT = Path(__file__).parent.parent


def setuptools_settings() -> dict[str, Any]:
    """Those of pyproject.toml."""
    tomllib = pytest.importorskip("tomllib", reason="tomllib came with Python 3.11")
    settings: dict[str, Any] = tomllib.loads((ROOT / "pyproject.toml").read_text())
    return settings["tool"]["setuptools"]


def test_the_wheel_holds_every_package_but_the_training_code() -> None:
    find_packages = pytest.importorskip("setuptools").find_packages
    packages = find_packages(str(ROOT), **setuptools_settings()["packages"]["find"])
    folders = (
        p.parent
        for r in ("pnpdepth_cli", "model_zoo_defs")
        for p in (ROOT / r).rglob("__init__.py")
    )
    names = (".".join(f.relative_to(ROOT).parts) for f in folders)
    assert sorted(packages) == sorted(
        n for n in names if not n.startswith("model_zoo_defs.training")
    )


def test_every_file_that_is_no_module_is_listed_for_the_wheel() -> None:
    for package, patterns in setuptools_settings()["package-data"].items():
        listed = {path for pattern in patterns for path in (ROOT / package).glob(pattern)}
        training = ROOT / "model_zoo_defs" / "training"  # stays out of the wheel
        files = {path for path in (ROOT / package).rglob("*") if path.is_file()}
        files = {path for path in files if training not in path.parents}
        left_out = {path for path in files - listed if path.suffix not in (".py", ".pyc")}
        weights = {path for path in left_out if path.name.endswith(".safetensors")}
        assert left_out == weights  # of editions that lie in the repository alone


def test_the_version_is_that_of_the_citation_and_of_the_changelog() -> None:
    citation = (ROOT / "CITATION.cff").read_text()
    (released,) = re.findall(r'^date-released: "?([\d-]+)"?$', citation, re.MULTILINE)
    assert f"\nversion: {pnp.__version__}\n" in citation
    sections = [line for line in (ROOT / "CHANGELOG.md").open() if line.startswith("## ")]
    first = next(line for line in sections if line != "## Unreleased\n")
    assert first == f"## {pnp.__version__} ({released})\n"


def test_the_package_runs_as_a_module_like_the_command(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "pnpdepth_cli"]
    done = subprocess.run([*command, "--version"], capture_output=True, text=True, check=True)
    assert done.stdout == f"pnpdepth, version {pnp.__version__}\n"
    command += ["refine", "no.png", "--sparse", "no.png"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=tmp_path)
    assert (done.returncode, done.stderr.count("\n")) == (3, 1)
    assert done.stderr.startswith("pnpdepth: ")
    assert not list(tmp_path.iterdir())


def test_the_line_of_the_documentation_completes_commands_and_options_in_bash() -> None:
    scripts = Path(sys.executable).parent
    if not (shutil.which("bash") and (scripts / "pnpdepth").is_file()):
        pytest.skip("needs bash and an installed command")
    (line,) = re.findall(r'^eval ".*"$', (ROOT / "docs/install.md").read_text(), re.MULTILINE)
    script = f"""{line}
        COMP_WORDS=(pnpdepth cl) COMP_CWORD=1
        _pnpdepth_completion pnpdepth; echo "${{COMPREPLY[@]}}"; COMPREPLY=()
        COMP_WORDS=(pnpdepth refine --unc) COMP_CWORD=2
        _pnpdepth_completion pnpdepth; echo "${{COMPREPLY[@]}}"
    """
    path = os.pathsep.join([str(scripts), os.environ["PATH"]])
    done = subprocess.run(
        ["bash", "-c", script], capture_output=True, text=True, env={**os.environ, "PATH": path},
        check=True,
    )  # fmt: skip
    assert done.stdout.split() == ["cloud", "--uncertainty"]


@pytest.mark.slow
def test_the_wheel_is_small_and_refines_a_sample_from_an_empty_folder(tmp_path: Path) -> None:
    # The wheel, built from a copy of the sources.
    pytest.importorskip("build", reason="needs build")
    source, installed, empty = (tmp_path / name for name in ("source", "installed", "empty"))
    source.mkdir()
    empty.mkdir()
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    for name in ("pnpdepth_cli", "model_zoo_defs"):
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    build = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", "dist"]
    done = subprocess.run(build, cwd=source, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    (wheel,) = (source / "dist").glob("*.whl")
    assert wheel.stat().st_size < 12e6
    names = zipfile.ZipFile(wheel).namelist()
    assert "model_zoo_defs/weights/compact.safetensors" in names
    assert not [name for name in names if "training" in name or name.startswith("tests")]
    zipfile.ZipFile(wheel).extractall(installed)

    # It refines by its own files, and says which weights it has not.
    sample = ROOT / "samples" / "indoor"
    code = (
        "import pnpdepth_cli; print(pnpdepth_cli.__file__)\n"
        "from pnpdepth_cli.cli.main import main; main()"
    )
    command = [sys.executable, "-c", code, "refine", str(sample / "rgb.png"), "--sparse"]
    command += [str(sample / "sparse.png"), "-o"]
    environment = {**os.environ, "PYTHONPATH": str(installed)}

    def refine(*more: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [*command, *more], env=environment, cwd=empty, capture_output=True, text=True,
            check=False,
        )  # fmt: skip

    done = refine("out")
    assert done.returncode == 0, done.stderr
    assert Path(done.stdout.splitlines()[0]).is_relative_to(installed)
    files = (empty / "out/rgb_depth.png", sample / "gt.png")
    assert pnp.score(*(read_depth(path).values for path in files)).mae < 0.2
    done = refine("other", "--model", "eigen-tiny")
    assert (done.returncode, "eigen-tiny.safetensors" in done.stderr) == (4, True)
