"""Drives the worker over many inputs, restarts it when it dies, and judges what it reports."""

from __future__ import annotations

import json
import os
import select
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

SECONDS, BYTES = 5.0, 1.5e9
"""CPU time and memory that no input may exceed."""
START_S, SILENCE_S = 900, 240
"""Wall-clock time before and between reports after which the worker hangs, on a busy machine."""
CODES = {0, 2, 3, 4, 5, 6, 7}
"""Exit codes of the program that are not its own bug."""


@dataclass(kw_only=True)
class FuzzResult:
    """What a run showed."""

    inputs: int = 0
    """Number of inputs."""
    findings: list[str] = field(default_factory=list)
    """Inputs that broke a promise, by their number and file, and how."""
    codes: Counter[object] = field(default_factory=Counter)
    """Number of inputs by exit code."""


def fuzz(folder: Path, seed: int, count: int) -> FuzzResult:
    """Runs that many inputs and returns what they showed.

    Args:
        folder: An existing folder; the worker writes the valid files into files/ of it.
        seed: Of the mutations.
        count: Number of inputs.
    """
    result = FuzzResult()
    while result.inputs < count:
        started: dict[str, Any] | None = None
        for line in _reports(folder / "files", seed, result.inputs, count - result.inputs):
            if "start" in line:
                started = line
                continue
            started = None
            result.inputs += 1
            result.codes[line["code"]] += 1
            where = f"input {line['end']} ({line['file']})"
            result.findings += [f"{where}: {problem}" for problem in _problems(line)]
        if started is not None:
            where = f"input {started['start']} ({started['file']})"
            result.findings.append(f"{where}: the process died or hung")
            result.inputs += 1
        elif result.inputs < count:
            raise RuntimeError("the fuzz worker ended before its first input")
    return result


def _reports(folder: Path, seed: int, first: int, count: int) -> Iterator[dict[str, Any]]:
    """The worker's lines until it ends or is silent for too long."""
    command = [sys.executable, "-m", "tests.fuzz.worker", str(folder), str(seed)]
    environment = os.environ | {"PYTHONPATH": str(Path.cwd()), "OMP_NUM_THREADS": "1"}
    with subprocess.Popen(
        [*command, str(first), str(count)],
        stdout=subprocess.PIPE,
        env=environment,
        text=True,
        cwd=Path.cwd(),
    ) as process:
        assert process.stdout is not None
        silence_s = START_S
        while select.select([process.stdout], [], [], silence_s)[0]:
            silence_s = SILENCE_S
            text = process.stdout.readline()
            if not text:
                return
            yield json.loads(text)
        process.kill()


def _problems(line: dict[str, Any]) -> Iterator[str]:
    """Promises that an input broke."""
    if line["code"] not in CODES or "Traceback" in line["stderr"]:
        yield f"exit code {line['code']}: {line['stderr'][-1500:]}"
    if line["seconds"] > SECONDS:
        yield f"{line['seconds']:.1f} s"
    if line["bytes"] > BYTES:
        yield f"{line['bytes'] / 1e9:.1f} GB"
    if line["events"]:
        yield f"caused {', '.join(line['events'])}"
