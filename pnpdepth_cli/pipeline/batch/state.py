"""The run manifests of an output folder: which frames are done, and whether they are up to date.

`batch.jsonl`, or `batch.2of8.jsonl` of a shard, gets a line before a frame's files are written
("begun") and one after ("done", "diverged" or "failed"). A line holds the digest of the settings,
and size, time and digest of every file that was read and written. So a later run recognises what is
missing, outdated or interrupted.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path
from typing import Any, Literal, Protocol

from pnpdepth_cli.errors import OutputError
from pnpdepth_cli.io.atomic import cannot_write, remove_leftovers
from pnpdepth_cli.io.fingerprint import Fingerprint, fingerprint, is_unchanged
from pnpdepth_cli.io.journal import EncodedLine, Journal
from pnpdepth_cli.pipeline.batch.frames import Task
from pnpdepth_cli.pipeline.batch.settings import SettingsDigests, settings_digest

Status = Literal["done", "diverged", "failed"]

Line = dict[str, Any]
"""A line of a run manifest."""
KEY = "frame"
"""Identifies a line, by the name of its frame."""
NEW = "new"
_MANIFEST = re.compile(r"batch(\.\d+of\d+)?\.jsonl")


class FrameRecorder(Protocol):
    """Records what is done, in the manifest or for it."""

    @property
    def output(self) -> Path:
        """The output folder."""

    @property
    def model(self) -> dict[str, Any]:
        """The network's `model_identity`."""

    def begin(self, task: Task) -> None:
        """Records that files of this frame may exist from now on."""

    def finish(
        self, task: Task, status: Status, row: dict[str, Any], read: dict[str, Fingerprint]
    ) -> None:
        """Records that the frame is done, with the fingerprints of its inputs."""

    def fail(self, task: Task, row: dict[str, Any]) -> None:
        """Records why the frame failed."""


class BatchState:
    """The run manifests of an output folder; this run writes its own and reads all of them.

    Args:
        output: The folder.
        shard: (i, n) of this run; None for all frames.
        model: The network's `model_identity`.
    """

    def __init__(self, output: Path, shard: tuple[int, int] | None, model: dict[str, Any]) -> None:
        self.output = output
        self.model = model
        self._digests = SettingsDigests(model)
        part = "" if shard is None else f".{shard[0]}of{shard[1]}"
        own = output / f"batch{part}.jsonl"
        existed = own.exists()
        self._own = Journal(own, KEY)
        self.read_others()
        self.fresh = not existed and not self._others
        """True if no batch wrote to the folder before."""

    def read_others(self) -> None:
        """Reads what the other shards have done up to now."""
        paths = sorted(self.output.iterdir()) if self.output.is_dir() else []
        self._others = [
            Journal(path, KEY)
            for path in paths
            if _MANIFEST.fullmatch(path.name) and path.name != self._own.path.name
        ]

    def notes(self) -> list[str]:
        """Returns a warning for each damaged manifest."""
        return [
            f"warning: {journal.lost} lines of {journal.path} are damaged; their frames are refined"
            " again"
            for journal in (self._own, *self._others)
            if journal.lost
        ]

    def why_to_do(self, task: Task) -> str | None:
        """Returns why the frame is to be done; None if it is done with these settings and files.

        The reason is a word or two, with details after a colon.
        """
        lines = self._lines(task.name)
        if not lines:
            return NEW
        digest = self.settings(task)
        reasons = [self._why_not(line, task, digest) for line in lines]
        return None if None in reasons else reasons[0]

    def result_of(self, name: str, digest: str) -> Line | None:
        """Returns the line of a frame with these settings, of this run or before; or None.

        Args:
            name: Of the frame.
            digest: As `settings` returns it.
        """
        lines = [line for line in self._lines(name) if line.get("settings") == digest]
        lines.sort(key=lambda line: line["state"] == "failed")
        return lines[0] if lines else None

    def check_foreign(self, paths: Iterable[Path]) -> None:
        """Raises OutputError if one of the files exists, and no batch wrote it."""
        for path in paths:
            if path.exists():
                raise OutputError(
                    f"{path} exists, and no batch wrote it; --overwrite replaces such files, -o"
                    " names another folder"
                )

    def begin(self, task: Task) -> None:
        """Records that files of this frame may exist from now on."""
        self.record(begun_line(task.name))

    def finish(
        self, task: Task, status: Status, row: dict[str, Any], read: dict[str, Fingerprint]
    ) -> None:
        """Records that the frame is done, with the fingerprints of its inputs and outputs."""
        self.record(finished_line(self, task, status, row, read))

    def fail(self, task: Task, row: dict[str, Any]) -> None:
        """Records why the frame failed; the next run tries it again."""
        self.record(failed_line(self, task, row))

    def record(self, *lines: Line | EncodedLine) -> None:
        """Appends lines to the manifest of this run."""
        self._own.append(*lines)

    def settings(self, task: Task) -> str:
        """Returns the digest of the settings of a frame."""
        return self._digests.of(task.request)

    def _lines(self, name: str) -> list[dict[str, Any]]:
        lines = [journal.newest(name) for journal in (self._own, *self._others)]
        return [line for line in lines if line is not None]

    def _why_not(self, line: dict[str, Any], task: Task, digest: str) -> str | None:
        if line["state"] == "begun":
            return "interrupted"
        if line["state"] == "failed":
            return "failed before"
        if line.get("settings") != digest:
            return "other settings"
        read, written = (
            {name: Fingerprint(**known) for name, known in line[kind].items()}
            for kind in ("inputs", "outputs")
        )
        if read.keys() != task.inputs.keys():
            return "other input files"
        for part, path in task.inputs.items():
            if not is_unchanged(path, read[part]):
                return f"input changed: {part}"
        for path in task.outputs.paths():
            known = written.get(path.relative_to(self.output).as_posix())
            if known is None and path in task.outputs.optional():
                continue
            if known is None or not is_unchanged(path, known):
                return f"result {'changed' if path.exists() else 'missing'}: {path.name}"
        return None


def begun_line(name: str) -> Line:
    """Returns the line before the files of a frame are written."""
    return {"frame": name, "state": "begun"}


def finished_line(
    recorder: FrameRecorder,
    task: Task,
    status: Status,
    row: dict[str, Any],
    read: dict[str, Fingerprint],
) -> Line:
    """Returns the line of a frame whose files are written."""
    written = {path: fingerprint(path) for path in task.outputs.paths()}
    return {
        "frame": task.name,
        "state": status,
        "settings": settings_digest(task.request, recorder.model),
        "inputs": {part: asdict(known) for part, known in read.items()},
        "outputs": {
            path.relative_to(recorder.output).as_posix(): asdict(known)
            for path, known in written.items()
        },
        "row": row,
    }


def failed_line(recorder: FrameRecorder, task: Task, row: dict[str, Any]) -> Line:
    """Returns the line of a frame that could not be refined."""
    digest = settings_digest(task.request, recorder.model)
    return {"frame": task.name, "state": "failed", "settings": digest, "row": row}


def input_fingerprints(task: Task) -> dict[str, Fingerprint]:
    """Returns the fingerprints of the frame's files. Raises InputError if one is missing."""
    return {part: fingerprint(path) for part, path in task.inputs.items()}


def remove_all_leftovers(output: Path) -> int:
    """Removes the half-written files of a killed run below the folder; returns how many."""
    folders = [Path(folder) for folder, _, _ in os.walk(output)]
    try:
        return sum(remove_leftovers(folder) for folder in folders)
    except OSError as error:
        raise cannot_write(output, error) from error
