"""The record beside a result is the state of a batch: how the result was made, and of which files.

`NAME.json` is written last, by rename, and removed before the files of `NAME` are written again.
Its entry `batch` holds the digest of the settings and what identifies the inputs.
"""

from __future__ import annotations

import functools
import hashlib
import json
import os
from collections.abc import Callable, Iterable, Mapping
from dataclasses import fields, replace
from fnmatch import fnmatch
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pnpdepth_cli import __version__
from pnpdepth_cli.commands.batch.find_frames import Task
from pnpdepth_cli.commands.batch.summary import CSV, JSON
from pnpdepth_cli.commands.refinement.output_files import IMAGES, Outputs, stale_outputs
from pnpdepth_cli.commands.refinement.refine_request import RefineRequest
from pnpdepth_cli.dataset.frame_record import BatchState, FrameRecord
from pnpdepth_cli.errors import FileFormatError, OutputError
from pnpdepth_cli.file_record import FileRecord
from pnpdepth_cli.io.atomic import LOCKS, cannot_write, make_folder, remove_leftovers
from pnpdepth_cli.io.file_bytes import Fingerprint, cannot_read, is_unchanged, sha256_of
from pnpdepth_cli.io.text_files import parse_json, plain
from pnpdepth_cli.models.definition import file_and_part
from pnpdepth_cli.settings import Settings

if TYPE_CHECKING:
    from pnpdepth_cli.commands.refinement.refine_image import RefineOutcome

_OWN_SUMMARY = b'{\n  "command": "batch"'


class Records:
    """The records in an output folder; what changes later in a listed folder is not seen.

    Args:
        output: The folder.
        model: The network's `model_identity`.
    """

    def __init__(self, output: Path, model: dict[str, Any]) -> None:
        self.output, self.model = output, model
        self._last: tuple[dict[str, Any], str] | None = None
        self._names_in = functools.lru_cache(maxsize=64)(_names_in)

    def check_new(self, tasks: Iterable[Task]) -> None:
        """Raises OutputError if no batch has written to the folder, and a result exists there."""
        names_in = functools.cache(_names_in)
        names = names_in(self.output)
        if not names or any(fnmatch(name, LOCKS) for name in names):
            return
        if JSON in names and (_content(self.output / JSON) or b"").startswith(_OWN_SUMMARY):
            return
        results = (path for task in tasks for path in task.outputs.values())
        for path in (self.output / CSV, self.output / JSON, *results):
            if path.name in names_in(path.parent):
                raise OutputError(
                    f"{path} exists, and no batch wrote it; --overwrite replaces such files, -o"
                    " names another folder"
                )

    def reason_to_refine(self, task: Task) -> str | None:
        """Returns why a frame is to be refined; None if it is done with its settings and files.

        The reason is a word or two, with details after a colon.
        """
        names, files = self._names_in(task.record.parent), task.outputs
        if task.record.name not in names:
            return "interrupted" if any(path.name in names for path in files.values()) else "new"
        record = _read(task.record)
        if record is None:
            return "record damaged"
        if record.batch is None:
            return "other settings"
        if record.status == "failed":
            return "failed before"
        if record.batch.settings != self._digest(task):
            return "other settings"
        known = record.batch.inputs
        if known.keys() != task.inputs.keys():
            return "other input files"
        for part, path in task.inputs.items():
            if not is_unchanged(path, known[part]):
                return f"input changed: {part}"
        for kind, path in files.items():
            if kind not in IMAGES and path.name not in names:
                return f"result missing: {path.name}"
        return None

    def record_of(self, task: Task) -> FrameRecord | None:
        """Returns the record of a frame with its present settings; None if there is none."""
        record = _read(task.record)
        if record is None or record.batch is None or record.batch.settings != self._digest(task):
            return None
        return record

    def write(
        self,
        task: Task,
        inputs: Mapping[str, Fingerprint],
        write: Callable[[Outputs], RefineOutcome],
    ) -> FrameRecord:
        """Writes the results of a frame, the record last, and returns the record.

        Args:
            task: The frame.
            inputs: Fingerprints of its files, by part.
            write: Function that writes all but the record to the paths that it is given.
        """
        planned = task.outputs
        make_folder(task.record.parent, below=self.output)
        _remove(task.record)
        for path in stale_outputs(self.output, task.name, planned):
            _remove(path)
        outcome = write({kind: path for kind, path in planned.items() if kind != "record"})
        written = [*outcome.outputs, "record"]
        record = replace(
            outcome.record,
            batch=BatchState(settings=self._digest(task), inputs=dict(inputs)),
            outputs={k: planned[k].relative_to(self.output).as_posix() for k in written},
        )
        record.write(planned["record"])
        return record

    def fail(self, task: Task, message: str) -> FrameRecord:
        """Writes a record that says why a frame failed, and returns it."""
        record = FrameRecord(
            name=task.name,
            group=task.group,
            status="failed",
            message=message,
            batch=BatchState(settings=self._digest(task)),
            inputs={part: FileRecord(path=str(path)) for part, path in task.inputs.items()},
        )
        make_folder(task.record.parent, below=self.output)
        record.write(task.record)
        return record

    def _digest(self, task: Task) -> str:
        """The SHA-256 of the settings that decide the frame's result."""
        files, last = task.request.settings("files", "reading"), self._last  # several threads ask
        arrays = files.get("neighbours")
        if not arrays and last is not None and last[0] == files:  # as of most consecutive frames
            return last[1]
        text = json.dumps(settings_of(task.request, self.model), sort_keys=True)
        digest = hashlib.sha256(text.encode()).hexdigest()
        self._last = None if arrays else (files, digest)
        return digest


def settings_of(request: RefineRequest, model: dict[str, Any], *groups: str) -> dict[str, Any]:
    """Returns the settings that decide a frame's result, in JSON's own types.

    The files of the frame, its calibration among them, are compared by their content elsewhere.

    Args:
        request: Request of the frame.
        model: The `model_identity` of the request.
        *groups: Names of the request's groups. None: all of them.
    """
    values = {
        name: value
        for name, value in request.settings(*groups).items()
        if name != "more_models" and (value or name != "neighbours")
    }
    if "neighbours" in values:
        values["neighbours"] = [(other.motion, other.apart) for other in values["neighbours"]]
    if "device" in values:  # devices of one kind give equal results, so shards may use one each
        values["device"] = values["device"].split(":")[0]
    settings: dict[str, Any] = plain(values | model)
    for name in ("calib", "extrinsics"):
        settings.get("scan", {}).pop(name, None)
    return settings


def model_identity(request: RefineRequest) -> dict[str, Any]:
    """Returns the program's version and the digests of the network's files and of code.

    A file's name with its :ATTRIBUTE, :OUTPUT or :KEY counts; its folder does not.
    """
    network = request.network
    identity = {"version": __version__, **_identity(network.model), "checkpoint": None}
    if network.checkpoint is not None:
        file, key = file_and_part(network.checkpoint)
        identity |= {"checkpoint": sha256_of(file)} | ({"state_dict": key} if key else {})
    more, code = [_identity(spec) for spec in network.more_models], code_digests(request.method)
    identity |= {"more_models": more} if more else {}
    return identity | ({"code": code} if code else {})


def code_digests(method: Settings) -> dict[str, str]:
    """Returns the SHA-256 of the user's Python files among the settings, such as of --loss."""
    values = (getattr(method, field.name) for field in fields(method))
    files = {value for value in values if isinstance(value, str) and value.endswith(".py")}
    return {file: sha256_of(Path(file)) for file in sorted(files)}


def _identity(spec: str) -> dict[str, Any]:
    path, part = file_and_part(Path(spec))
    files = [path] if path.is_file() else sorted(p for p in path.glob("*") if p.is_file())
    return {
        "model": f"{path.name}:{part}".rstrip(":") if files else spec,
        "model_files": {p.name: sha256_of(p) for p in files},
    }


def remove_all_leftovers(output: Path) -> int:
    """Removes the half-written files of a killed run below the folder; returns how many."""
    try:
        return sum(remove_leftovers(Path(folder)) for folder, _, _ in os.walk(output))
    except OSError as error:
        raise cannot_write(output, error) from error


def _read(path: Path) -> FrameRecord | None:
    """The record in a file; None if there is none, or it is damaged."""
    try:
        return FrameRecord.from_json(parse_json(_content(path) or b""), path)
    except (ValueError, RecursionError, FileFormatError):
        return None


def _content(path: Path) -> bytes | None:
    try:
        return path.read_bytes() if path.is_file() else None  # no pipe, which never ends
    except OSError:
        return None


def _remove(path: Path) -> None:
    try:
        path.unlink(missing_ok=True)
    except OSError as error:
        raise cannot_write(path, error) from error


def _names_in(folder: Path) -> frozenset[str]:
    """The names in a folder; none if there is no such folder."""
    try:
        return frozenset(entry.name for entry in os.scandir(folder))
    except FileNotFoundError:
        return frozenset()
    except OSError as error:
        raise cannot_read(folder, error) from error
