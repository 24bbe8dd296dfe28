"""The wheel holds every package of the source tree, and the package runs as the command."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path
from typing import NamedTuple

import pytest

import pnpdepth_cli as pnp
from pnpdepth_cli.io.depth import read_depth

ROOT = Path(__file__).parent.parent


def test_the_wheel_holds_every_package_and_file_but_the_training_code() -> None:
    tomllib = pytest.importorskip("tomllib", reason="tomllib came with Python 3.11")
    find_packages = pytest.importorskip("setuptools").find_packages
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]
    packages = set(find_packages(str(ROOT), **settings["packages"]["find"]))
    found = [*ROOT.glob("pnpdepth_cli/**/*"), *ROOT.glob("model_zoo_defs/**/*")]
    files = {path for path in found if path.is_file() and "training" not in path.parts}
    folders = {path.parent for path in files if path.name == "__init__.py"}
    assert packages == {".".join(folder.relative_to(ROOT).parts) for folder in folders}
    patterns = settings["package-data"].items()
    listed = {p for package, globs in patterns for g in globs for p in (ROOT / package).glob(g)}
    left_out = {path for path in files - listed if path.suffix not in (".py", ".pyc")}
    # the weights of editions that lie in the repository alone
    assert {path.suffix for path in left_out} <= {".safetensors"}


def test_the_version_is_that_of_the_citation_and_of_the_changelog() -> None:
    citation = (ROOT / "CITATION.cff").read_text()
    (released,) = re.findall(r'^date-released: "?([\d-]+)"?$', citation, re.MULTILINE)
    assert f"\nversion: {pnp.__version__}\n" in citation
    sections = re.findall("^## (?!Unreleased)(.*)$", (ROOT / "CHANGELOG.md").read_text(), re.M)
    assert sections[0] == f"{pnp.__version__} ({released})"


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
    environment = os.environ | {"PATH": os.pathsep.join([str(scripts), os.environ["PATH"]])}
    shown = subprocess.check_output(["bash", "-c", script], text=True, env=environment)
    assert shown.split() == ["cloud", "--uncertainty"]


def test_the_public_ci_runs_every_part_of_the_script_on_the_lowest_and_the_highest_python() -> None:
    yaml, tomllib = map(pytest.importorskip, ("yaml", "tomllib"))
    script = (ROOT / ".ci" / "run").read_text()
    jobs = yaml.safe_load((ROOT / ".github" / "workflows" / "ci.yml").read_text())["jobs"]
    steps = [step["run"].split() for job in jobs.values() for step in job["steps"] if "run" in step]
    assert {program for program, *_ in steps} == {".ci/run"}
    parts = {name for _, *parts in steps for name in parts if name.isalpha()}
    parts |= {row["part"] for row in jobs["more"]["strategy"]["matrix"]["include"]}
    assert parts == {*re.findall(r"^part_(\w+)\(\)", script, re.MULTILINE)}
    classifiers = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["classifiers"]
    lowest, *_, highest = (c.split()[-1] for c in classifiers if "Python :: 3." in c)
    assert jobs["readme"]["strategy"]["matrix"]["python"] == [lowest, highest]


class Wheel(NamedTuple):
    """A wheel that was built from a copy of the sources."""

    file: Path
    installed: Path
    """The folder into which it was unpacked."""


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Wheel:
    pytest.importorskip("build", reason="needs build")
    folder = tmp_path_factory.mktemp("wheel")
    source = folder / "source"
    for name in ("pnpdepth_cli", "model_zoo_defs"):
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    build = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", "dist"]
    done = subprocess.run(build, cwd=source, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    (file,) = (source / "dist").glob("*.whl")
    zipfile.ZipFile(file).extractall(folder / "installed")
    return Wheel(file=file, installed=folder / "installed")


def refine_with(wheel: Wheel, empty: Path, *more: str) -> subprocess.CompletedProcess[str]:
    """`refine` of a sample from an empty folder, which first prints where the package is."""
    sample = ROOT / "samples" / "indoor"
    code = (
        "import pnpdepth_cli; print(pnpdepth_cli.__file__)\n"
        "from pnpdepth_cli.cli.main import main; main()"
    )
    command = [sys.executable, "-c", code, "refine", str(sample / "rgb.png")]
    command += ["--sparse", str(sample / "sparse.png"), *more]
    environment = {**os.environ, "PYTHONPATH": str(wheel.installed)}
    return subprocess.run(
        command, env=environment, cwd=empty, capture_output=True, text=True, check=False
    )


@pytest.mark.slow
def test_the_wheel_is_less_than_12_megabytes(wheel: Wheel) -> None:
    assert wheel.file.stat().st_size < 12e6


@pytest.mark.slow
def test_the_wheel_has_neither_training_nor_tests(wheel: Wheel) -> None:
    names = zipfile.ZipFile(wheel.file).namelist()
    assert not [name for name in names if "training" in name or name.startswith("tests")]


@pytest.mark.slow
def test_the_wheel_refines_a_sample_from_an_empty_folder(wheel: Wheel, tmp_path: Path) -> None:
    done = refine_with(wheel, tmp_path, "-o", "out")
    assert done.returncode == 0, done.stderr
    assert Path(done.stdout.splitlines()[0]).is_relative_to(wheel.installed)
    depth = read_depth(tmp_path / "out/rgb_depth.png").values
    truth = read_depth(ROOT / "samples/indoor/gt.png").values
    assert pnp.score(depth, truth)["mae"] < 0.2


@pytest.mark.slow
def test_the_wheel_names_the_file_of_weights_that_it_has_not(wheel: Wheel, tmp_path: Path) -> None:
    done = refine_with(wheel, tmp_path, "-o", "other", "--model", "eigen-tiny")
    assert done.returncode == 4, done.stderr
    assert "eigen-tiny.safetensors" in done.stderr
    assert Path(done.stdout.splitlines()[0]).is_relative_to(wheel.installed)
