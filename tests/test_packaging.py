"""The wheel holds every package of the source tree, and the package runs as the command."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from pnpdepth_cli import __version__
from pnpdepth_cli.models.registry import find_definition

ROOT = Path(__file__).parent.parent


@pytest.mark.skipif(sys.version_info < (3, 11), reason="tomllib came with Python 3.11")
def test_the_wheel_holds_every_package_but_the_training_code() -> None:
    import tomllib
    from setuptools import find_packages

    find = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["packages"]
    found = find_packages(str(ROOT), **find["find"])
    folders = (
        p.parent
        for r in ("pnpdepth_cli", "model_zoo_defs")
        for p in (ROOT / r).rglob("__init__.py")
    )
    names = (".".join(f.relative_to(ROOT).parts) for f in folders)
    assert sorted(found) == sorted(n for n in names if not n.startswith("model_zoo_defs.training"))


@pytest.mark.skipif(sys.version_info < (3, 11), reason="tomllib came with Python 3.11")
def test_every_file_that_is_no_module_is_listed_for_the_wheel() -> None:
    import tomllib

    setuptools = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]
    for package, patterns in setuptools["package-data"].items():
        listed = {path for pattern in patterns for path in (ROOT / package).glob(pattern)}
        files = {path for path in (ROOT / package).rglob("*") if path.is_file()}
        assert {path for path in files - listed if path.suffix not in (".py", ".pyc")} == set()


def test_the_shipped_weights_are_there_and_small() -> None:
    checkpoint = find_definition("compact").checkpoint
    assert checkpoint is not None
    assert 1e6 < checkpoint.stat().st_size < 20e6


def test_the_package_runs_as_a_module_like_the_command() -> None:
    command = [sys.executable, "-m", "pnpdepth_cli"]
    done = subprocess.run([*command, "--version"], capture_output=True, text=True, check=True)
    assert done.stdout == f"pnpdepth, version {__version__}\n"
    wrong = subprocess.run([*command, "refin"], capture_output=True, text=True, check=False)
    assert wrong.returncode == 2
    assert "Usage: pnpdepth " in wrong.stderr
