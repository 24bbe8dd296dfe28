"""The public CI runs the parts of .ci/run, and these name things that exist."""

from __future__ import annotations

import re
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


def test_the_workflow_runs_every_part_of_the_script_and_nothing_else() -> None:
    words = [command.split() for command in steps()]
    assert {command[0] for command in words} == {".ci/run"}
    assert {part for command in words for part in command[1:]} == parts()
    assert set(re.findall(r"^part_(\w+)\(\)", SCRIPT, re.MULTILINE)) == parts()


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
