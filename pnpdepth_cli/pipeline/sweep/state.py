"""Remembers the results of a sweep, and whether they are up to date."""

from __future__ import annotations

import json
import zlib
from dataclasses import asdict
from pathlib import Path
from typing import Any

from pnpdepth_cli.errors import OutputError
from pnpdepth_cli.io.atomic import atomic_path, cannot_write
from pnpdepth_cli.io.fingerprint import Fingerprint, fingerprint, is_unchanged
from pnpdepth_cli.io.record import plain
from pnpdepth_cli.io.remote.store import local_files
from pnpdepth_cli.pipeline.sweep.plan import Run
from pnpdepth_cli.pipeline.sweep.points import OWN, calibration_file

RESULTS = ("sweep.json", "sweep.csv", "sweep_frames.csv", "sweep.tex")


class SweepState:
    """The results in `sweep.jsonl`, a line for each run, which ends with its checksum.

    Lines that are damaged, or were not written to their end, are removed.

    Attributes:
        notes: A warning if lines were damaged.

    Raises:
        OutputError: If the folder has results that no sweep wrote.
    """

    def __init__(self, output: Path) -> None:
        self._path = output / "sweep.jsonl"
        unowned = [name for name in RESULTS if (output / name).exists()]
        if unowned and not self._path.exists():
            raise OutputError(
                f"{output / unowned[0]} exists, and no sweep wrote it; -o names another folder"
            )
        self._lines: dict[str, dict[str, Any]] = {}
        self.notes: list[str] = []
        if self._path.exists():
            self._read()

    def _read(self) -> None:
        lines = self._path.read_bytes().splitlines(keepends=True)
        whole = [line for line in lines if _content(line) is not None]
        for line in whole:
            content = _content(line)
            assert content is not None
            self._lines[content["run"]] = content
        damaged = sum(line.endswith(b"\n") for line in lines) - len(whole)
        if damaged:
            self.notes.append(
                f"warning: {damaged} lines of {self._path} are damaged; their runs are repeated"
            )
        if len(whole) < len(lines):
            with atomic_path(self._path) as temporary:
                temporary.write_bytes(b"".join(whole))

    def result(self, key: str) -> dict[str, Any] | None:
        """Returns the run's line; None if it was not computed."""
        line = self._lines.get(key)
        return line if line is not None and line.get("state") == "done" else None

    def is_done(self, run: Run) -> bool:
        """Returns True if all scores of the run exist, of the files as they are now."""
        line = self._still_good(run)
        return line is not None and {str(k) for k in run.iterations} <= line["scores"].keys()

    def add(self, run: Run, result: dict[str, Any]) -> None:
        """Records the result, with known scores after other numbers of updates."""
        before = self._still_good(run)
        if before is not None and "scores" in result:
            result = result | {"scores": before["scores"] | result["scores"]}
        files = _files(run)
        with local_files(files.values()) as copies:
            inputs = {n: fingerprint(p, copies.get(p)).as_record() for n, p in files.items()}
        self._append(
            {
                "run": run.key,
                "frame": run.frame.name,
                "seed": run.seed,
                "sampling": asdict(run.sampling),
                "method": None if run.method is None else run.method.record(),
                "inputs": inputs,
                **result,
            }
        )

    def fail(self, run: Run, message: str) -> None:
        """Records why the run failed; the next sweep tries it again."""
        self._append(
            {"run": run.key, "frame": run.frame.name, "seed": run.seed, "state": "failed",
             "message": message}
        )  # fmt: skip

    def _append(self, content: dict[str, Any]) -> None:
        content = json.loads(json.dumps(plain(content), allow_nan=False))
        line = json.dumps(content | {"crc32": _checksum(content)})
        try:
            with self._path.open("a", encoding="ascii") as file:
                file.write(f"{line}\n")
        except OSError as error:
            raise cannot_write(self._path, error) from error
        self._lines[content["run"]] = content

    def _still_good(self, run: Run) -> dict[str, Any] | None:
        line, files = self.result(run.key), _files(run)
        if line is None or line["inputs"].keys() != files.keys():
            return None
        known = {name: Fingerprint(**seen) for name, seen in line["inputs"].items()}
        return line if all(is_unchanged(files[name], known[name]) for name in files) else None


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


def _files(run: Run) -> dict[str, Path]:
    """The files that decide the run."""
    calib = calibration_file(run.sampling, run.frame)
    own = run.sampling.sensor == OWN
    read = {name: p for name, p in run.task.inputs.items() if own or name in ("image", "gt")}
    return read | ({} if calib is None else {"calib": calib})
