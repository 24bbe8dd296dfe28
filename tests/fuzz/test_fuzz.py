"""Damaged files of every kind end in one line and an exit code, in bounded time and memory.

PNPDEPTH_FUZZ_INPUTS and PNPDEPTH_FUZZ_SEED ask for more than the few hundred inputs of a test run.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from tests.fuzz.fuzzing import fuzz
from tests.fuzz.mutations import mutated
from tests.fuzz.worker import problem

pytestmark = pytest.mark.slow
pytest.importorskip("resource")  # peak memory; not on Windows

INPUTS = int(os.environ.get("PNPDEPTH_FUZZ_INPUTS", "600"))
SEED = int(os.environ.get("PNPDEPTH_FUZZ_SEED", "0"))


def test_no_damaged_file_causes_a_traceback_a_hang_or_much_memory(tmp_path: Path) -> None:
    result = fuzz(tmp_path, SEED, INPUTS)
    assert result.findings == []
    assert result.inputs == INPUTS
    assert min(result.codes[0], result.codes[3]) > 0  # some inputs stay valid, most do not


def test_changes_outside_the_folder_and_processes_are_findings(tmp_path: Path) -> None:
    inside, outside = str(tmp_path / "a" / "x"), str(tmp_path / "a" / ".." / "x")
    found = {
        "a process": problem("subprocess.Popen", (), tmp_path / "a"),
        "read outside": problem("open", (outside, "r", os.O_RDONLY), tmp_path / "a"),
        "written inside": problem("open", (inside, "w", os.O_WRONLY), tmp_path / "a"),
        "written outside": problem("open", (outside, "w", os.O_WRONLY), tmp_path / "a"),
        "moved outside": problem("os.rename", (inside, outside, -1, -1), tmp_path / "a"),
    }
    assert found == {
        "a process": "subprocess.Popen",
        "read outside": None,
        "written inside": None,
        "written outside": f"open {tmp_path / 'x'}",
        "moved outside": f"os.rename {tmp_path / 'x'}",
    }


def test_the_same_seed_and_number_give_the_same_bytes() -> None:
    data = Path(__file__).read_bytes()
    first, second, other = (
        mutated(data, np.random.default_rng((3, number))) for number in (7, 7, 8)
    )
    assert first == second != other
