"""Remembers the results of a sweep."""

from __future__ import annotations

import json
import zlib
from pathlib import Path
from typing import Any

from pnpdepth_cli.commands.sweep.plan import Run
from pnpdepth_cli.errors import OutputError
from pnpdepth_cli.io.atomic import atomic_path, cannot_write
from pnpdepth_cli.io.record import plain

RESULTS = ("sweep.json", "sweep.csv", "sweep_frames.csv", "sweep.tex")


class Journal:
    """The results in `sweep.jsonl`, a line for each run, which ends with its checksum.

    Lines that are damaged, or were not written to their end, are removed.

    Attributes:
        notes: A warning if lines were damaged.

    Raises:
        OutputError: If the folder has results that no sweep wrote.
    """

    def __init__(self, output: Path) -> None:
        self._path = output / "sweep.jsonl"
        self._lines: dict[str, dict[str, Any]] = {}
        self.notes: list[str] = []
        if self._path.exists():
            self._read()
        elif unowned := [name for name in RESULTS if (output / name).exists()]:
            raise OutputError(
                f"{output / unowned[0]} exists, and no sweep wrote it; -o names another folder"
            )

    def _read(self) -> None:
        lines = self._path.read_bytes().splitlines(keepends=True)
        read = [(line, _content(line)) for line in lines]
        whole = [(line, content) for line, content in read if content is not None]
        self._lines = {content["run"]: content for _, content in whole}
        if damaged := sum(line.endswith(b"\n") for line in lines) - len(whole):
            self.notes.append(
                f"warning: {damaged} lines of {self._path} are damaged; their runs are repeated"
            )
        if len(whole) < len(lines):
            with atomic_path(self._path) as temporary:
                temporary.write_bytes(b"".join(line for line, _ in whole))

    def result(self, run: Run) -> dict[str, Any] | None:
        """Returns the run's result; None if it was not computed."""
        return self._lines.get(run.key)

    def is_done(self, run: Run) -> bool:
        """Returns True if all scores of the run exist, of the files as they are now."""
        line = self.result(run)
        return line is not None and {str(k) for k in run.iterations} <= line["scores"].keys()

    def add(self, run: Run, result: dict[str, Any]) -> None:
        """Records the result, with known scores after other numbers of updates."""
        if before := self.result(run):
            result = result | {"scores": before["scores"] | result["scores"]}
        line = {"run": run.key, "frame": run.frame.name, "seed": run.seed}
        content = json.loads(json.dumps(plain(line | result), allow_nan=False))
        try:
            with self._path.open("a", encoding="ascii") as file:
                file.write(json.dumps(content | {"crc32": _checksum(content)}) + "\n")
        except OSError as error:
            raise cannot_write(self._path, error) from error
        self._lines[run.key] = content


def _content(line: bytes) -> dict[str, Any] | None:
    """What a line holds, without its checksum; None if it is damaged."""
    try:
        content = json.loads(line)
    except ValueError:
        return None
    if not isinstance(content, dict) or not line.endswith(b"\n"):
        return None
    checksum = content.pop("crc32", None)
    return content if checksum == _checksum(content) else None


def _checksum(content: dict[str, Any]) -> int:
    return zlib.crc32(json.dumps(content).encode())
