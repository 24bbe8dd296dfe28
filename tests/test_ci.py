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


def test_the_workflow_runs_every_part_of_the_script_and_nothing_else() -> None:
    parts = set(re.findall(r'^all_parts="(.*)"$', SCRIPT, re.MULTILINE)[0].split())
    assert set(re.findall(r"^part_(\w+)\(\)", SCRIPT, re.MULTILINE)) == parts
    ran = [step["run"].split() for job in JOBS.values() for step in job["steps"] if "run" in step]
    rows = JOBS["more"]["strategy"]["matrix"]["include"]
    assert {command[0] for command in ran} == {".ci/run"}
    named = {part for command in ran for part in command[1:] if part.isalpha()} - {"matrix"}
    assert named | {row["part"] for row in rows} == parts


def test_the_workflow_takes_the_oldest_and_the_newest_python_of_the_classifiers() -> None:
    supported = [c.split()[-1] for c in PROJECT["classifiers"] if "Python :: 3." in c]
    assert JOBS["readme"]["strategy"]["matrix"]["python"] == [supported[0], supported[-1]]


def test_the_extras_that_the_script_installs_exist() -> None:
    installed = ",".join(re.findall(r"\.\[([\w,]+)\]", SCRIPT)).split(",")
    assert {*installed} <= {*PROJECT["optional-dependencies"]}
