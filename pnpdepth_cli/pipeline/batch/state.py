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
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any, Literal, Protocol

from pnpdepth_cli.errors import OutputError
from pnpdepth_cli.io.atomic import cannot_write, remove_leftovers
from pnpdepth_cli.io.fingerprint import Fingerprint, is_unchanged
from pnpdepth_cli.io.journal import EncodedLine, Journal
from pnpdepth_cli.io.remote.address import RemotePath
from pnpdepth_cli.io.remote.segments import SegmentedJournal
from pnpdepth_cli.io.remote.store import StatusIndex
from pnpdepth_cli.pipeline.batch.frames import Task
from pnpdepth_cli.pipeline.batch.output_folder import OutputFolder
from pnpdepth_cli.pipeline.batch.settings import SettingsDigests, settings_digest

Status = Literal["done", "diverged", "failed"]

Line = dict[str, Any]
"""A line of a run manifest."""
KEY = "frame"
"""Identifies a line, by the name of its frame."""
NEW = "new"
_LINES_AT_ONCE = 1000
_MANIFEST = re.compile(r"batch(\.\d+of\d+)?\.jsonl")


@dataclass(frozen=True, kw_only=True)
class Fingerprints:
    """What identifies the files of a frame that is done."""

    read: dict[str, Fingerprint]
    """Of its inputs when they were read, by part."""
    written: dict[Path, Fingerprint]
    """Of its results."""


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

    def finish(self, task: Task, status: Status, row: dict[str, Any], known: Fingerprints) -> None:
        """Records that the frame is done, with the fingerprints of its files."""

    def fail(self, task: Task, row: dict[str, Any]) -> None:
        """Records why the frame failed."""


class BatchState:
    """The run manifests of an output folder; this run writes its own and reads all of them.

    Args:
        folder: The folder that is written to.
        shard: (i, n) of this run; None for all frames.
        model: The network's `model_identity`.
    """

    def __init__(
        self, folder: OutputFolder, shard: tuple[int, int] | None, model: dict[str, Any]
    ) -> None:
        self.output = folder.output
        self.model = model
        self.folder = folder
        self._digests = SettingsDigests(model)
        self._index = StatusIndex()
        self._announced = False
        self._start = f"{folder.output}/"
        part = "" if shard is None else f".{shard[0]}of{shard[1]}"
        own = folder.local / f"batch{part}.jsonl"
        existed = own.exists()
        self._own = folder.journal(own, KEY)
        self.read_others()
        self.fresh = not existed and not self._others
        """True if no batch wrote to the folder before."""

    def read_others(self) -> None:
        """Reads what the other shards have done up to now."""
        paths = sorted(self.folder.local.iterdir()) if self.folder.local.is_dir() else []
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
        lines = self._lines(task.name, before="row")
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
            if self._exists(path):
                raise OutputError(
                    f"{path} exists, and no batch wrote it; --overwrite replaces such files, -o"
                    " names another folder"
                )

    def _exists(self, path: Path) -> bool:
        if isinstance(path, RemotePath):
            return self._index.status(path) is not None
        return path.exists()

    def announce(self, names: Iterable[str]) -> None:
        """Records that files of all these frames may exist, where a line for each is too slow."""
        if isinstance(self._own, SegmentedJournal):
            self._announced = True
            remaining = iter(names)
            while some := [begun_line(name) for name in islice(remaining, _LINES_AT_ONCE)]:
                self._own.append(*some)
            self._own.publish()

    def close(self) -> None:
        """Puts the lines of this run into the store, if the output is there."""
        if isinstance(self._own, SegmentedJournal):
            self._own.publish()

    def begin_all(self, names: Iterable[str]) -> None:
        """Records that files of these frames may exist from now on."""
        if not self._announced:
            self.record(*(begun_line(name) for name in names))

    def begin(self, task: Task) -> None:
        """Records that files of this frame may exist from now on."""
        self.begin_all([task.name])

    def finish(self, task: Task, status: Status, row: dict[str, Any], known: Fingerprints) -> None:
        """Records that the frame is done, with the fingerprints of its files."""
        self.record(finished_line(self, task, status, row, known))

    def fail(self, task: Task, row: dict[str, Any]) -> None:
        """Records why the frame failed; the next run tries it again."""
        self.record(failed_line(self, task, row))

    def record(self, *lines: Line | EncodedLine) -> None:
        """Appends lines to the manifest of this run."""
        self._own.append(*lines)

    def settings(self, task: Task) -> str:
        """Returns the digest of the settings of a frame."""
        return self._digests.of(task.request)

    def _lines(self, name: str, before: str | None = None) -> list[dict[str, Any]]:
        lines = [journal.newest(name, before) for journal in (self._own, *self._others)]
        return [line for line in lines if line is not None]

    def _relative(self, path: Path) -> str:
        """The path below the output folder; `Path.relative_to` takes ten times as long."""
        text = str(path)
        if os.sep == "/" and text.startswith(self._start):
            return text[len(self._start) :]
        return path.relative_to(self.output).as_posix()

    def _why_not(self, line: dict[str, Any], task: Task, digest: str) -> str | None:
        if line["state"] == "begun":
            return "interrupted"
        if line["state"] == "failed":
            return "failed before"
        if line.get("settings") != digest:
            return "other settings"
        read, written = line["inputs"], line["outputs"]
        if read.keys() != task.inputs.keys():
            return "other input files"
        for part, path in task.inputs.items():
            if not is_unchanged(path, Fingerprint(**read[part]), self._index):
                return f"input changed: {part}"
        for path in task.outputs.paths():
            known = written.get(self._relative(path))
            if known is None and path in task.outputs.optional():
                continue
            if known is None or not is_unchanged(path, Fingerprint(**known), self._index):
                return f"result {'changed' if self._exists(path) else 'missing'}: {path.name}"
        return None


def begun_line(name: str) -> Line:
    """Returns the line before the files of a frame are written."""
    return {"frame": name, "state": "begun"}


def finished_line(
    recorder: FrameRecorder,
    task: Task,
    status: Status,
    row: dict[str, Any],
    known: Fingerprints,
) -> Line:
    """Returns the line of a frame whose files are written."""
    return {
        "frame": task.name,
        "state": status,
        "settings": settings_digest(task.request, recorder.model),
        "inputs": {part: each.as_record() for part, each in known.read.items()},
        "outputs": {
            path.relative_to(recorder.output).as_posix(): each.as_record()
            for path, each in known.written.items()
        },
        "row": row,
    }


def failed_line(recorder: FrameRecorder, task: Task, row: dict[str, Any]) -> Line:
    """Returns the line of a frame that could not be refined."""
    digest = settings_digest(task.request, recorder.model)
    return {"frame": task.name, "state": "failed", "settings": digest, "row": row}


def remove_all_leftovers(output: Path) -> int:
    """Removes the half-written files of a killed run below the folder; returns how many."""
    folders = [Path(folder) for folder, _, _ in os.walk(output)]
    try:
        return sum(remove_leftovers(folder) for folder in folders)
    except OSError as error:
        raise cannot_write(output, error) from error
