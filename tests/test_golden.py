"""What the commands of `benchmarks.golden` print and write, against golden.json.

Numbers may differ by rounding; on a processor that rounds otherwise they are not compared. After a
change that is meant to change an output, write it again and read what git shows:
`python -m benchmarks.golden write tests/golden.json --portable`.
"""

from __future__ import annotations

import json
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch

from benchmarks.golden.__main__ import ENVIRONMENT, PROCESSOR, processor
from benchmarks.golden.differences import nearly, portable
from benchmarks.golden.inputs import make_inputs
from benchmarks.golden.normalise import Normaliser
from benchmarks.golden.running import files_in, output_of
from benchmarks.golden.steps import Step, groups
from pnpdepth_cli.cli.main import run

KEPT = json.loads(Path(__file__).with_name("golden.json").read_text("utf-8"))
SAME_PROCESSOR = KEPT[PROCESSOR] == processor()
STEPS = {step.name: (group, step) for group in groups() if not group.shared for step in group.steps}
Outputs = dict[str, Any]
"""Of the steps that ran, by their names."""


@pytest.fixture(scope="module")
def work(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the inputs in `in`."""
    folder = tmp_path_factory.mktemp("golden")
    make_inputs(folder / "in")
    return folder


@pytest.fixture(scope="module")
def outputs() -> Outputs:
    return {}


@pytest.fixture(autouse=True)
def environment(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """That of `benchmarks.golden`: one thread, of which the order of sums depends."""
    for name, value in ENVIRONMENT.items():
        monkeypatch.setenv(name, value)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.mark.parametrize("name", STEPS)
def test_a_command_prints_and_writes_what_it_did(
    name: str,
    work: Path,
    outputs: Outputs,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    group, wanted = STEPS[name]
    if group.name == "hugging-face":
        pytest.importorskip("transformers")
    folder = work / group.name
    folder.mkdir(exist_ok=True)
    monkeypatch.chdir(folder)
    for step in group.steps[: group.steps.index(wanted) + 1]:  # one needs those before it
        if step.name not in outputs:
            outputs[step.name] = output_here(step, Normaliser(work, None), capfd)
    assert list(nearly(KEPT[name], outputs[name], numbers=SAME_PROCESSOR)) == []


def output_here(step: Step, norm: Normaliser, capfd: pytest.CaptureFixture[str]) -> Any:
    """Runs a step in this process and folder; returns its portable output."""
    if step.remove is not None:
        Path(step.remove).unlink()
    folder = Path.cwd()
    before = files_in(folder)
    capfd.readouterr()
    code = run(shlex.split(step.line))
    stdout, stderr = capfd.readouterr()
    printed = {"exit": code, "stdout": stdout, "stderr": stderr}
    output = portable(output_of(step, folder, before, printed, norm))
    if step.save is not None:
        Path(step.save).write_text(stdout, "utf-8")
    return json.loads(json.dumps(output))
