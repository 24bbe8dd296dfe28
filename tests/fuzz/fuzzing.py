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

import numpy as np

from tests.fuzz.mutations import mutated

SECONDS, BYTES = 5.0, 1.5e9
"""CPU time and memory that no input may exceed."""
START_S, SILENCE_S = 900, 240
"""Wall-clock time before and between reports after which the worker hangs, on a busy machine."""
CODES = {0, 2, 3, 4, 5, 6, 7}
"""Exit codes of the program that are not its own bug."""


@dataclass(frozen=True, kw_only=True)
class Finding:
    """An input that broke a promise."""

    number: int
    """Number of the input; with the seed it gives the bytes."""
    file: str
    """Name of the damaged file."""
    problem: str
    """Which promise, and how."""
    data: bytes
    """The damaged file."""

    def __str__(self) -> str:
        return f"input {self.number} ({self.file}): {self.problem}"


@dataclass(kw_only=True)
class FuzzResult:
    """All findings of a run, and what it cost."""

    inputs: int = 0
    """Number of inputs."""
    findings: list[Finding] = field(default_factory=list)
    """Inputs that broke a promise."""
    codes: Counter[int] = field(default_factory=Counter)
    """Number of inputs by exit code."""
    slowest_s: float = 0.0
    """Most CPU seconds of one input."""
    largest_bytes: float = 0.0
    """Most memory that one input added to the peak."""


def fuzz(folder: Path, seed: int, first: int, count: int) -> FuzzResult:
    """Runs inputs FIRST to FIRST + COUNT - 1 and returns what they showed.

    Args:
        folder: An existing folder; the worker writes the valid files into files/ of it.
        seed: Of the mutations.
        first: Number of the first input.
        count: Number of inputs.
    """
    result = FuzzResult()
    folder = folder / "files"
    end = first + count
    while first < end:
        started: dict[str, Any] | None = None
        for line in _reports(folder, seed, first, end - first):
            if "start" in line:
                started = line
                continue
            started = None
            first = line["end"] + 1
            _record(result, folder, seed, line)
        if started is not None:
            data = (folder / started["file"]).read_bytes()  # the worker did not put it right again
            problem = "the process died or hung"
            result.findings.append(
                Finding(number=started["start"], file=started["file"], problem=problem, data=data)
            )
            first = started["start"] + 1
            result.inputs += 1
        elif first < end:
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


def _record(result: FuzzResult, folder: Path, seed: int, line: dict[str, Any]) -> None:
    result.inputs += 1
    result.codes[line["code"] if isinstance(line["code"], int) else 1] += 1
    result.slowest_s = max(result.slowest_s, line["seconds"])
    result.largest_bytes = max(result.largest_bytes, line["bytes"])
    for problem in _problems(line):
        result.findings.append(_finding(folder, seed, line["end"], line, problem))


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


def _finding(folder: Path, seed: int, number: int, line: dict[str, Any], problem: str) -> Finding:
    file = line["file"]
    data = mutated((folder / file).read_bytes(), np.random.default_rng((seed, number)))
    return Finding(number=number, file=file, problem=problem, data=data)
