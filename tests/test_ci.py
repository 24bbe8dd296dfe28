"""The public CI runs the parts of .ci/run, and these name things that exist."""

from __future__ import annotations

import re
import shlex
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest

yaml = pytest.importorskip("yaml")
tomllib = pytest.importorskip("tomllib", reason="tomllib came with Python 3.11")

ROOT = Path(__file__).parent.parent
SCRIPT = (ROOT / ".ci" / "run").read_text()
WORKFLOW = ROOT / ".github" / "workflows" / "ci.yml"
JOBS: dict[str, Any] = yaml.safe_load(WORKFLOW.read_text())["jobs"]
PROJECT: dict[str, Any] = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def parts() -> set[str]:
    """Those that .ci/run runs if it is given none."""
    return set(re.findall(r'^all_parts="(.*)"$', SCRIPT, re.MULTILINE)[0].split())


def steps() -> list[str]:
    """The commands of the workflow, with each value of the matrix."""
    commands = []
    for job in JOBS.values():
        matrix = job["strategy"]["matrix"].get("include", [{}])
        for step in job["steps"]:
            for row in matrix if "run" in step else ():
                commands.append(
                    re.sub(r"\$\{\{ matrix\.(\w+) \}\}", lambda m, r=row: r[m[1]], step["run"])
                )
    return commands


def pytest_commands() -> list[list[str]]:
    """The arguments of each call of pytest in .ci/run and of the README command for the tests."""
    text = SCRIPT + (ROOT / "README.md").read_text(encoding="utf-8")
    return [
        shlex.split(call) for call in re.findall(r"/pytest ([^|\n]*?)(?: 2>&1.*)?$", text, re.M)
    ]


def test_the_workflow_runs_every_part_of_the_script_and_nothing_else() -> None:
    words = [command.split() for command in steps()]
    assert {command[0] for command in words} == {".ci/run"}
    assert {part for command in words for part in command[1:]} == parts()


def test_every_part_is_a_function_of_the_script() -> None:
    assert set(re.findall(r"^part_(\w+)\(\)", SCRIPT, re.MULTILINE)) == parts()


def test_the_script_refuses_an_unknown_part() -> None:
    if not shutil.which("bash"):
        pytest.skip("needs bash")
    done = subprocess.run(
        ["bash", str(ROOT / ".ci" / "run"), "test"], capture_output=True, text=True
    )
    assert done.returncode == 2
    assert parts() <= set(done.stdout.split())


def test_the_workflow_takes_the_oldest_and_the_newest_python_of_the_classifiers() -> None:
    supported = [c.split()[-1] for c in PROJECT["classifiers"] if "Python :: 3." in c]
    for job in JOBS.values():
        matrix = job["strategy"]["matrix"]
        assert set(matrix.get("python", [])) <= set(supported)
        assert {row["python"] for row in matrix.get("include", [])} <= set(supported)
    assert JOBS["readme"]["strategy"]["matrix"]["python"] == [supported[0], supported[-1]]


def test_the_extras_that_the_script_installs_exist_and_bring_the_programs_that_it_calls() -> None:
    extras = PROJECT["optional-dependencies"]
    installed = {
        name for names in re.findall(r"\.\[([\w,]+)\]", SCRIPT) for name in names.split(",")
    }
    assert installed <= set(extras)
    called = set(re.findall(r"^ *\$bin/(\w+)", SCRIPT, re.MULTILINE)) - {"pip", "python", "pytest"}
    programs = {re.split(r"[>=\[-]", need)[0] for name in ("dev", "docs") for need in extras[name]}
    assert called <= programs


def test_the_marks_and_options_that_pytest_is_given_exist(pytestconfig: pytest.Config) -> None:
    marks = {line.split(":")[0] for line in pytestconfig.getini("markers")}
    assert len(pytest_commands()) >= 4
    for arguments in pytest_commands():
        for option, value in zip(arguments, [*arguments[1:], ""], strict=True):
            if option == "-m":
                assert value in marks
            elif option.startswith("--"):
                pytestconfig.getoption(option)  # raises if there is none
