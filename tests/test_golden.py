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

import pytest
import torch

from benchmarks.golden.__main__ import ENVIRONMENT, PROCESSOR, processor
from benchmarks.golden.differences import nearly, portable
from benchmarks.golden.inputs import make_inputs
from benchmarks.golden.normalise import Normaliser
from benchmarks.golden.running import files_in, output_of
from benchmarks.golden.steps import Group, groups
from pnpdepth_cli.cli.main import run

KEPT = json.loads(Path(__file__).with_name("golden.json").read_text("utf-8"))
SAME_PROCESSOR = KEPT[PROCESSOR] == processor()
GROUPS = [group for group in groups() if not group.shared and group.steps[0].figures]


@pytest.fixture(scope="module")
def work(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the inputs in `in`."""
    folder = tmp_path_factory.mktemp("golden")
    make_inputs(folder / "in")
    return folder


@pytest.fixture(autouse=True)
def environment(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """That of `benchmarks.golden`: one thread, of which the order of sums depends."""
    for name, value in ENVIRONMENT.items():
        monkeypatch.setenv(name, value)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.mark.parametrize("group", GROUPS, ids=[group.name for group in GROUPS])
def test_commands_print_and_write_what_they_did(
    group: Group, work: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    if group.name == "hugging-face":
        pytest.importorskip("transformers")
    folder, norm = work / group.name, Normaliser(work, None)
    folder.mkdir()
    monkeypatch.chdir(folder)
    for step in group.steps:
        if step.remove is not None:
            Path(step.remove).unlink()
        before = files_in(folder)
        capfd.readouterr()
        code = run(shlex.split(step.line))
        stdout, stderr = capfd.readouterr()
        printed = {"exit": code, "stdout": stdout, "stderr": stderr}
        now = json.loads(json.dumps(portable(output_of(step, folder, before, printed, norm))))
        assert list(nearly(KEPT[step.name], now, numbers=SAME_PROCESSOR)) == []
        if step.save is not None:
            Path(step.save).write_text(stdout, "utf-8")
