"""What was done before, and whether it still holds: the run manifests of an output folder.

`batch.jsonl`, or `batch.2of8.jsonl` of a shard, grows by a line before a frame's files are written
("begun") and by one after ("done", "diverged" or "failed"). A line holds the digest of the
settings, and size, time and digest of every file that was read and written; so a re-run knows what
is missing or was made otherwise, and a run that is killed at any moment is seen as such.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path
from typing import Any, Literal

from pnpdepth_cli.errors import OutputError
from pnpdepth_cli.io.atomic import cannot_write, remove_leftovers
from pnpdepth_cli.io.fingerprint import Fingerprint, fingerprint, is_unchanged
from pnpdepth_cli.io.journal import Journal
from pnpdepth_cli.pipeline.batch.frames import Task
from pnpdepth_cli.pipeline.batch.settings import settings_digest

Status = Literal["done", "diverged", "failed"]

NEW = "new"
_MANIFEST = re.compile(r"batch(\.\d+of\d+)?\.jsonl")


class BatchState:
    """The run manifests of an output folder; this run writes its own, and reads all of them.

    model: the network's identity, as `model_identity` says it. fresh: no batch was there before.
    """

    def __init__(self, output: Path, shard: tuple[int, int] | None, model: dict[str, Any]) -> None:
        self.output = output
        self.model = model
        part = "" if shard is None else f".{shard[0]}of{shard[1]}"
        own = output / f"batch{part}.jsonl"
        made_before = own.exists()
        self._own = Journal(own, "frame")
        self.read_others()
        self.fresh = not made_before and not self._others

    def read_others(self) -> None:
        """What the other shards have done up to now is known."""
        paths = sorted(self.output.iterdir()) if self.output.is_dir() else []
        self._others = [
            Journal(path, "frame")
            for path in paths
            if _MANIFEST.fullmatch(path.name) and path.name != self._own.path.name
        ]

    def notes(self) -> list[str]:
        """What is to be said of the manifests."""
        return [
            f"warning: {journal.lost} lines of {journal.path} mean nothing; what they said is done"
            " again"
            for journal in (self._own, *self._others)
            if journal.lost
        ]

    def why_to_do(self, task: Task) -> str | None:
        """Why the frame is to be done; None if it has been, with these settings and files.

        A word or two, and details behind a colon.
        """
        lines = self._lines(task.name)
        if not lines:
            return NEW
        digest = self._settings(task)
        reasons = [self._why_not(line, task, digest) for line in lines]
        return None if None in reasons else reasons[0]

    def result_of(self, task: Task) -> dict[str, Any] | None:
        """What became of the frame with these settings, in this run or before; None if nothing."""
        digest = self._settings(task)
        found = [line for line in self._lines(task.name) if line.get("settings") == digest]
        found.sort(key=lambda line: line["state"] == "failed")
        return found[0] if found else None

    def check_foreign(self, paths: Iterable[Path]) -> None:
        """OutputError if one of the files that a batch would write is there, not from a batch."""
        for path in paths:
            if path.exists():
                raise OutputError(
                    f"{path} exists, and no batch made it; --overwrite replaces such files, -o"
                    " names another folder"
                )

    def begin(self, task: Task) -> None:
        """It is known that files of this frame may be there from now on."""
        self._own.append({"frame": task.name, "state": "begun"})

    def finish(
        self, task: Task, status: Status, row: dict[str, Any], read: dict[str, Fingerprint]
    ) -> None:
        """It is known that the frame is done, and which files it was made of and into."""
        written = {path: fingerprint(path) for path in task.outputs.paths()}
        self._own.append(
            {
                "frame": task.name,
                "state": status,
                "settings": self._settings(task),
                "inputs": {part: asdict(known) for part, known in read.items()},
                "outputs": {
                    path.relative_to(self.output).as_posix(): asdict(known)
                    for path, known in written.items()
                },
                "row": row,
            }
        )

    def fail(self, task: Task, row: dict[str, Any]) -> None:
        """It is known that the frame cannot be done, and why; it is tried again by the next run."""
        self._own.append(
            {
                "frame": task.name,
                "state": "failed",
                "settings": self._settings(task),
                "row": row,
            }
        )

    def _settings(self, task: Task) -> str:
        return settings_digest(task.request, self.model)

    def _lines(self, name: str) -> list[dict[str, Any]]:
        lines = [journal.newest(name) for journal in (self._own, *self._others)]
        return [line for line in lines if line is not None and "state" in line]

    def _why_not(self, line: dict[str, Any], task: Task, digest: str) -> str | None:
        if line["state"] == "begun":
            return "interrupted"
        if line["state"] == "failed":
            return "failed before"
        if line.get("settings") != digest:
            return "other settings"
        try:
            read, written = (
                {name: Fingerprint(**known) for name, known in line[kind].items()}
                for kind in ("inputs", "outputs")
            )
        except (KeyError, TypeError, AttributeError):
            return "recorded in a way that is not understood"
        if read.keys() != task.inputs.keys():
            return "other input files"
        for part, path in task.inputs.items():
            if not is_unchanged(path, read[part]):
                return f"input changed: {part}"
        for path in task.outputs.paths():
            known = written.get(path.relative_to(self.output).as_posix())
            if known is None or not is_unchanged(path, known):
                return f"result {'changed' if path.exists() else 'missing'}: {path.name}"
        return None


def known_inputs(task: Task) -> dict[str, Fingerprint]:
    """What the files are known by that are read for the frame. InputError if one is not there."""
    return {part: fingerprint(path) for part, path in task.inputs.items()}


def remove_all_leftovers(output: Path) -> int:
    """No file that a killed run left half-written is below the folder; returns how many were."""
    folders = [Path(folder) for folder, _, _ in os.walk(output)]
    try:
        return sum(remove_leftovers(folder) for folder in folders)
    except OSError as error:
        raise cannot_write(output, error) from error
