"""The record beside a result is the state of a batch: how the result was made, and of which files.

`NAME.json` is written last, by rename, and removed before the files of `NAME` are written again.
Its entry `batch` holds the digest of the settings, what identifies the inputs, and the files
written; or why the frame failed.
"""

from __future__ import annotations

import hashlib
import json
import os
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from fnmatch import fnmatch
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pnpdepth_cli.commands.batch.frames import Task
from pnpdepth_cli.commands.batch.settings import settings_of
from pnpdepth_cli.commands.batch.summary import JSON, Tally, failed_row, row_of
from pnpdepth_cli.commands.refinement.output_files import Outputs
from pnpdepth_cli.errors import FileFormatError, OutputError
from pnpdepth_cli.io.atomic import cannot_write, make_folder, remove_leftovers
from pnpdepth_cli.io.fingerprint import Fingerprint, is_unchanged
from pnpdepth_cli.io.lock import LOCKS
from pnpdepth_cli.io.record import write_json
from pnpdepth_cli.io.remote import Listing, RemotePath, read_object, remove, renamed, upload

if TYPE_CHECKING:
    from pnpdepth_cli.commands.refinement.refine import RefineOutcome

Row = dict[str, Any]
NEW = "new"
_ENTRY = "batch"
_OWN_SUMMARY = b'{\n  "command": "batch"'
_LOCK = ".batch.lock"


class BatchState:
    """What an output folder holds of a batch.

    Args:
        output: The folder.
        model: The network's `model_identity`.
    """

    def __init__(self, output: Path, model: dict[str, Any]) -> None:
        self.output, self.model = output, model
        self._last: tuple[dict[str, Any], str] | None = None
        self._listing = Listing()
        names = self._listing.names(output)
        self._is_ours = any(fnmatch(name, LOCKS) for name in names) or (
            JSON in names and (_content(output / JSON) or b"").startswith(_OWN_SUMMARY)
        )

    def mark(self) -> None:
        """Marks a folder in a store as a batch's own; a lock does so on a disk."""
        if isinstance(self.output, RemotePath) and not self._is_ours:
            with tempfile.NamedTemporaryFile() as empty:
                upload(Path(empty.name), self.output / _LOCK)

    def reason_to_refine(self, task: Task) -> str | None:
        """Returns why a frame is to be refined; None if it is done with its settings and files.

        The reason is a word or two, with details after a colon.
        """
        names, files = self._listing.names(task.record.parent), task.outputs.by_kind()
        if task.record.name not in names:
            return "interrupted" if any(path.name in names for path in files.values()) else NEW
        entry = _entry(_record(task.record))
        if entry is None:
            return NEW
        if "failed" in entry:
            return "failed before"
        if entry["settings"] != self._digest(task):
            return "other settings"
        if entry["inputs"].keys() != task.inputs.keys():
            return "other input files"
        for part, path in task.inputs.items():
            try:
                known = Fingerprint(**entry["inputs"][part])
            except TypeError:
                return "record damaged"
            if not is_unchanged(path, known, self._listing):
                return f"input changed: {part}"
        may_lack = task.outputs.optional()
        for kind, path in files.items():
            wanted = kind in entry["outputs"] or path not in may_lack
            if wanted and path.name not in names:
                return f"result missing: {path.name}"
        return None

    def check_replaceable(self, paths: Iterable[Path], record: Path | None = None) -> None:
        """Raises OutputError if one of the files exists, and no batch wrote it.

        Args:
            paths: Files that are to be written.
            record: The record among them. Without one, the others are of an interrupted run if the
                folder is a batch's own.
        """
        for path in paths:
            if path.name not in self._listing.names(path.parent):
                continue
            by_batch = _entry(_record(path)) is not None if path == record else self._is_ours
            if not by_batch:
                raise OutputError(
                    f"{path} exists, and no batch wrote it; --overwrite replaces such files, -o"
                    " names another folder"
                )

    def row(self, task: Task) -> Row | None:
        """Returns the summary's row of a frame with its present settings; None if there is none.

        Raises:
            FileFormatError: The record is damaged.
        """
        record = _record(task.record)
        entry = _entry(record)
        if record is None or entry is None or entry["settings"] != self._digest(task):
            return None
        try:
            row = _row(task, record, entry)
            Tally().add(row)  # takes all that the summary takes
        except (AttributeError, IndexError, KeyError, TypeError) as error:
            raise FileFormatError(f"{task.record} is damaged; remove it, and run again") from error
        return row

    def write(
        self,
        task: Task,
        inputs: Mapping[str, Fingerprint],
        write: Callable[[Outputs], RefineOutcome],
    ) -> Row:
        """Writes the results of a frame, the record last; returns the summary's row.

        Args:
            task: The frame.
            inputs: What identifies its files, by part.
            write: Writes all but the record to the paths that it is given.
        """
        planned = task.outputs.by_kind()
        with _staged(task.outputs, self.output) as stage:
            _remove(task.record)
            outcome = write(replace(stage, record=None))
            staged = stage.by_kind()
            written = [*outcome.outputs.by_kind(), "record"]
            paths = {kind: planned[kind].relative_to(self.output).as_posix() for kind in written}
            entry = {
                "settings": self._digest(task),
                "inputs": {part: each.as_record() for part, each in inputs.items()},
                "outputs": paths,
            }
            record = {_ENTRY: entry} | outcome.record
            if isinstance(self.output, RemotePath):
                record = renamed(record, {str(staged[k]): str(planned[k]) for k in planned})
                for path in task.outputs.optional():
                    _remove(path)
            write_json(staged["record"], record)
            for kind in written:
                _put(staged[kind], planned[kind])
        return _row(task, record, entry)

    def fail(self, task: Task, message: str) -> Row:
        """Writes a record that says why a frame failed; returns the summary's row."""
        entry = {"settings": self._digest(task), "failed": message}
        with _staged(task.outputs, self.output) as stage:
            file = stage.by_kind()["record"]
            make_folder(file.parent)
            write_json(file, {_ENTRY: entry})
            _put(file, task.record)
        return _row(task, {}, entry)

    def _digest(self, task: Task) -> str:
        """The SHA-256 of the settings that decide the frame's result."""
        files, last = task.request.settings("files"), self._last  # several threads ask
        arrays = files.get("calibration") is not None or files.get("neighbours")
        if not arrays and last is not None and last[0] == files:  # as of most consecutive frames
            return last[1]
        text = json.dumps(settings_of(task.request, self.model), sort_keys=True)
        digest = hashlib.sha256(text.encode()).hexdigest()
        self._last = None if arrays else (files, digest)
        return digest


def remove_all_leftovers(output: Path) -> int:
    """Removes the half-written files of a killed run below the folder; returns how many."""
    try:
        return sum(remove_leftovers(Path(folder)) for folder, _, _ in os.walk(output))
    except OSError as error:
        raise cannot_write(output, error) from error


def _row(task: Task, record: Mapping[str, Any], entry: Mapping[str, Any]) -> Row:
    inputs = {part: str(path) for part, path in task.inputs.items()}
    if "failed" in entry:
        return failed_row(task.name, inputs, entry["failed"])
    return row_of(task.name, inputs, record, entry["outputs"])


def _entry(record: Mapping[str, Any] | None) -> dict[str, Any] | None:
    """What a batch says in a record; None if none wrote it."""
    entry: Any = None if record is None else record.get(_ENTRY)
    if not isinstance(entry, dict) or "settings" not in entry:
        return None
    whole = all(isinstance(entry.get(name), dict) for name in ("inputs", "outputs"))
    return entry if whole or "failed" in entry else None


def _record(path: Path) -> dict[str, Any] | None:
    """The content of a record; None if there is none, or another file."""
    try:
        record = json.loads(_content(path) or b"")
    except (ValueError, RecursionError):
        return None
    return record if isinstance(record, dict) else None


def _content(path: Path) -> bytes | None:
    if isinstance(path, RemotePath):
        return read_object(path)
    try:
        return path.read_bytes()
    except OSError:
        return None


def _remove(path: Path) -> None:
    if isinstance(path, RemotePath):
        remove(path)
        return
    try:
        path.unlink(missing_ok=True)
    except OSError as error:
        raise cannot_write(path, error) from error


def _put(file: Path, target: Path) -> None:
    if isinstance(target, RemotePath):
        upload(file, target)


@contextmanager
def _staged(outputs: Outputs, output: Path) -> Iterator[Outputs]:
    """Yields where the results of a frame are written: their own paths, or local ones."""
    if not isinstance(output, RemotePath):
        yield outputs
        return
    with tempfile.TemporaryDirectory(prefix="pnpdepth-") as folder:
        planned = outputs.by_kind().items()
        paths: Any = {kind: Path(folder) / path.relative_to(output) for kind, path in planned}
        yield replace(outputs, **paths)
