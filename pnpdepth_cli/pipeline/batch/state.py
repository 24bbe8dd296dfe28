"""The record beside a result is the state of a batch: how the result was made, and of which files.

`NAME.json` is written last, by rename, and removed before the files of `NAME` are written again.
Its entry `batch` holds the digest of the settings, what identifies the inputs, and the files
written; or why the frame failed.
"""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import replace
from fnmatch import fnmatch
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pnpdepth_cli.errors import FileFormatError, OutputError
from pnpdepth_cli.io.atomic import cannot_write, make_folder, remove_leftovers
from pnpdepth_cli.io.fingerprint import Fingerprint, is_unchanged
from pnpdepth_cli.io.lock import LOCKS
from pnpdepth_cli.io.record import write_json
from pnpdepth_cli.io.remote.address import RemotePath
from pnpdepth_cli.io.remote.store import Listing, read_object, remove, renamed, upload
from pnpdepth_cli.pipeline.batch.frames import Task
from pnpdepth_cli.pipeline.batch.settings import SettingsDigests
from pnpdepth_cli.pipeline.batch.summary import JSON, failed_row, row_of
from pnpdepth_cli.pipeline.refinement.output_files import Outputs

if TYPE_CHECKING:
    from pnpdepth_cli.pipeline.refinement.refine import RefineOutcome

Row = dict[str, Any]
NEW = "new"
_ENTRY = "batch"
_START = b'{\n  "batch": '
"""How a record of a batch begins; parsing the rest of it takes five times as long."""
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
        self._digests = SettingsDigests(model)
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
        names = self._listing.names(task.record.parent)
        if task.record.name not in names:
            there = any(path.name in names for path in task.outputs.paths())
            return "interrupted" if there else NEW
        entry = _entry(_record(task.record, entry_only=True))
        if entry is None:
            return NEW
        if "failed" in entry:
            return "failed before"
        if entry["settings"] != self._digests.of(task.request):
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
        for kind, path in task.outputs.by_kind().items():
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
        """Returns the summary's row of a frame with its present settings; None if there is none."""
        record = _record(task.record)
        entry = _entry(record)
        if record is None or entry is None or entry["settings"] != self._digests.of(task.request):
            return None
        try:
            return _row(task, record, entry)
        except (AttributeError, IndexError, KeyError, TypeError) as error:
            raise FileFormatError(f"{task.record} is damaged; remove it, and run again") from error

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

        Raises:
            OutputError: A file cannot be written.
        """
        with _staged(task.outputs, self.output) as stage:
            _remove(task.record)
            outcome = write(replace(stage, record=None))
            written = {**outcome.outputs.by_kind(), "record": _record_of(stage)}
            planned = task.outputs.by_kind()
            entry = {
                "settings": self._digests.of(task.request),
                "inputs": {part: each.as_record() for part, each in inputs.items()},
                "outputs": {
                    kind: planned[kind].relative_to(self.output).as_posix() for kind in written
                },
            }
            record = {_ENTRY: entry} | outcome.record
            if isinstance(self.output, RemotePath):
                names = {str(stage.by_kind()[kind]): str(path) for kind, path in planned.items()}
                record = renamed(record, names)
                for path in task.outputs.optional():
                    _remove(path)
            write_json(_record_of(stage), record)
            for kind, file in written.items():
                target = planned[kind]
                if isinstance(target, RemotePath):
                    upload(file, target)
        return _row(task, record, entry)

    def fail(self, task: Task, message: str) -> Row:
        """Writes a record that says why a frame failed; returns the summary's row."""
        entry = {"settings": self._digests.of(task.request), "failed": message}
        with _staged(task.outputs, self.output) as stage:
            make_folder(_record_of(stage).parent)
            write_json(_record_of(stage), {_ENTRY: entry})
            if isinstance(task.record, RemotePath):
                upload(_record_of(stage), task.record)
        return failed_row(task.name, _paths(task), message)


def remove_all_leftovers(output: Path) -> int:
    """Removes the half-written files of a killed run below the folder; returns how many."""
    try:
        return sum(remove_leftovers(Path(folder)) for folder, _, _ in os.walk(output))
    except OSError as error:
        raise cannot_write(output, error) from error


def _row(task: Task, record: Mapping[str, Any], entry: Mapping[str, Any]) -> Row:
    if "failed" in entry:
        return failed_row(task.name, _paths(task), entry["failed"])
    return row_of(task.name, _paths(task), record, entry["outputs"])


def _paths(task: Task) -> dict[str, str]:
    return {part: str(path) for part, path in task.inputs.items()}


def _entry(record: Mapping[str, Any] | None) -> dict[str, Any] | None:
    """What a batch says in a record; None if none wrote it."""
    entry: Any = None if record is None else record.get(_ENTRY)
    keys = entry.keys() if isinstance(entry, dict) else ()
    whole = "settings" in keys and (
        "failed" in keys or all(isinstance(entry.get(k), dict) for k in ("inputs", "outputs"))
    )
    return entry if whole else None


def _record(path: Path, *, entry_only: bool = False) -> dict[str, Any] | None:
    """The content of a record, or only its first entry; None if there is none, or another file."""
    data = _content(path)
    try:
        if entry_only and data is not None and data.startswith(_START):
            return {_ENTRY: json.JSONDecoder().raw_decode(data.decode(), len(_START))[0]}
        record = None if data is None else json.loads(data)
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


def _record_of(outputs: Outputs) -> Path:
    assert outputs.record is not None
    return outputs.record


def _remove(path: Path) -> None:
    if isinstance(path, RemotePath):
        remove(path)
        return
    try:
        with suppress(FileNotFoundError):
            path.unlink()
    except OSError as error:
        raise cannot_write(path, error) from error


@contextmanager
def _staged(outputs: Outputs, output: Path) -> Iterator[Outputs]:
    """Yields where the results of a frame are written: their own paths, or local ones."""
    if not isinstance(output, RemotePath):
        yield outputs
        return
    with tempfile.TemporaryDirectory(prefix="pnpdepth-") as folder:
        paths: dict[str, Any] = {
            kind: Path(folder) / path.relative_to(output)
            for kind, path in outputs.by_kind().items()
        }
        yield replace(outputs, **paths)
