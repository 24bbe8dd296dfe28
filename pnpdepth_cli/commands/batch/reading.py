"""Reads the files of a frame, those in a store through local copies."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any

from pnpdepth_cli.commands.batch.frames import Task
from pnpdepth_cli.commands.refinement.inputs import Inputs, read_inputs
from pnpdepth_cli.errors import PnpDepthError
from pnpdepth_cli.io.fingerprint import Fingerprint, fingerprint
from pnpdepth_cli.io.remote import RemotePath, local_files, renamed


def read_task(task: Task) -> tuple[Inputs, dict[str, Fingerprint]]:
    """Returns the contents of a frame's files, and their fingerprints by part.

    Names in records and messages are those of the task, not of copies.

    Raises:
        PnpDepthError: As of `read_inputs` and `local_files`.
    """
    with local_files(task.inputs.values()) as copies:
        fingerprints = {
            part: fingerprint(path, copies.get(path)) for part, path in task.inputs.items()
        }
        return _read(task, copies), fingerprints


def read_frame(task: Task) -> Inputs:
    """Returns what `read_task` does, without fingerprints."""
    with local_files(task.inputs.values()) as copies:
        return _read(task, copies)


def _read(task: Task, copies: Mapping[Path, Path]) -> Inputs:
    if not copies:
        return read_inputs(task.request)
    names = {str(copy): str(path) for path, copy in copies.items()}
    try:
        inputs = read_inputs(_with_copies(task.request, copies))
    except PnpDepthError as error:
        raise type(error)(renamed(str(error), names)) from error
    return replace(inputs, record=renamed(inputs.record, names), notes=renamed(inputs.notes, names))


def _with_copies(value: Any, copies: Mapping[Path, Path]) -> Any:
    """The request with the copies in the positions of the files in a store."""
    if isinstance(value, RemotePath):
        return copies.get(value, value)
    if isinstance(value, tuple):
        return tuple(_with_copies(item, copies) for item in value)
    if is_dataclass(value) and not isinstance(value, type):
        names = [field.name for field in fields(value) if field.init]
        return replace(value, **{n: _with_copies(getattr(value, n), copies) for n in names})
    return value
