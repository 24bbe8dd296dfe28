"""Runs groups of command lines, each step in a fork, and keeps what it printed and wrote."""

from __future__ import annotations

import atexit
import os
import runpy
import shlex
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from benchmarks.golden.normalise import Normaliser
from benchmarks.golden.steps import Group, Step

Observer = Callable[[str, Mapping[str, Any]], None]
"""Called with the name of each step that ended, and its output."""
State = tuple[int, int, int]
"""Size, modification time and inode of a file."""
LONGEST_S = 1200
"""A command that takes longer is ended, and has the signal as its exit code."""


def _run_here(arguments: Sequence[str], folder: Path) -> int:
    """Runs `pnpdepth` with the arguments in this process; its exit code."""
    os.chdir(folder)
    for number, name in ((0, os.devnull), (1, ".stdout"), (2, ".stderr")):
        flags = os.O_RDONLY if number == 0 else os.O_WRONLY | os.O_CREAT | os.O_TRUNC
        os.dup2(os.open(name, flags, 0o644), number)
    sys.stdin = open(0, closefd=False)  # noqa: SIM115
    sys.stdout = open(1, "w", encoding="utf-8", closefd=False)  # noqa: SIM115
    sys.stderr = open(  # noqa: SIM115
        2, "w", encoding="utf-8", errors="backslashreplace", buffering=1, closefd=False
    )
    signal.alarm(LONGEST_S)
    sys.argv = ["pnpdepth", *arguments]
    code = 0
    try:
        runpy.run_module("pnpdepth_cli", run_name="__main__")
    except SystemExit as stop:
        if isinstance(stop.code, str):
            print(stop.code, file=sys.stderr)
        code = stop.code if isinstance(stop.code, int) else int(stop.code is not None)
    except BaseException:
        traceback.print_exc()
        code = 1
    for thread in threading.enumerate():
        if thread is not threading.current_thread() and not thread.daemon:
            thread.join()
    atexit._run_exitfuncs()
    sys.stdout.flush()
    sys.stderr.flush()
    return code & 255


@dataclass
class _Running:
    """A group of which a step is running."""

    group: Group
    folder: Path
    next_step: int = 0
    known: Mapping[str, State] = field(default_factory=dict)

    @property
    def step(self) -> Step:
        return self.group.steps[self.next_step]


class Runner:
    """Runs groups in parallel.

    Attributes:
        results: Output of each step, by its name.
        seconds: CPU time of each step, by its name.
    """

    def __init__(
        self, work: Path, shared: Path | None, jobs: int, observe: Observer | None = None
    ) -> None:
        self._observe = observe
        self._work, self._jobs = work, jobs
        self._norm = Normaliser(work, shared)
        self.results: dict[str, dict[str, Any]] = {}
        self.seconds: dict[str, float] = {}

    def run(self, wanted: Sequence[Group]) -> None:
        """Runs all steps of the groups."""
        waiting, running = list(wanted), dict[int, _Running]()
        while waiting or running:
            while waiting and len(running) < self._jobs:
                group = waiting.pop(0)
                folder = self._work / group.name
                folder.mkdir()
                self._start(_Running(group=group, folder=folder), running)
            pid, status, usage = os.wait4(-1, 0)
            each = running.pop(pid)
            self.seconds[each.step.name] = usage.ru_utime + usage.ru_stime
            self._finish(each, os.waitstatus_to_exitcode(status))
            if each.next_step < len(each.group.steps):
                self._start(each, running)

    def _start(self, each: _Running, running: dict[int, _Running]) -> None:
        step = each.step
        if step.remove is not None:
            (each.folder / step.remove).unlink(missing_ok=True)
        each.known = files_in(each.folder)
        sys.stdout.flush()
        sys.stderr.flush()
        pid = os.fork()
        if pid == 0:
            code = 70
            try:
                code = _run_here(shlex.split(step.line), each.folder)
            except BaseException:
                traceback.print_exc()
            finally:
                os._exit(code)
        running[pid] = each

    def _finish(self, each: _Running, code: int) -> None:
        step = each.step
        each.next_step += 1
        streams = {kind: each.folder / f".{kind}" for kind in ("stdout", "stderr")}
        texts = {kind: path.read_bytes().decode() for kind, path in streams.items()}
        for path in streams.values():
            path.unlink()
        self.results[step.name] = output_of(
            step, each.folder, each.known, {"exit": code, **texts}, self._norm
        )
        if self._observe is not None:
            self._observe(step.name, self.results[step.name])
        if step.save is not None:
            (each.folder / step.save).write_text(texts["stdout"], "utf-8")


def output_of(
    step: Step,
    folder: Path,
    before: Mapping[str, State],
    printed: Mapping[str, Any],
    norm: Normaliser,
) -> dict[str, Any]:
    """What is kept of a step: its line, exit code, messages, files written, and files deleted.

    Args:
        before: The files of the folder, as of `files_in`, when the step began.
        printed: The exit code, stdout and stderr.
    """
    now = files_in(folder)
    return {
        "line": step.line,
        "exit": printed["exit"],
        "stdout": norm.printed(printed["stdout"], step),
        "stderr": norm.printed(printed["stderr"], step),
        "files": {
            name: norm.file(folder / name, step)
            for name, state in now.items()
            if before.get(name) != state
        },
        "gone": sorted(set(before) - set(now)),
    }


def files_in(folder: Path) -> dict[str, State]:
    """The state of every file below the folder, by relative path."""
    return {
        path.relative_to(folder).as_posix(): (
            (state := path.stat()).st_size, state.st_mtime_ns, state.st_ino
        )
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }  # fmt: skip
