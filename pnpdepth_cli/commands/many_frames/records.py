"""The records of a batch, by which its frames are done.

`NAME.json` beside a result says how it was made, and of which files. It is written last, by rename,
and removed before the files of `NAME` are written again. Its entry `batch` holds the digest of the
settings and what identifies the inputs.
"""

from __future__ import annotations

import hashlib
import json
import traceback
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path

from pnpdepth_cli.commands.many_frames.find_frames import (
    CSV,
    JSON,
    input_files,
    request_of,
)
from pnpdepth_cli.commands.requests.batch_request import BatchRequest
from pnpdepth_cli.commands.requests.refine_request import GROUPS, Outputs, RefineRequest
from pnpdepth_cli.dataset.frame_files import FrameFiles
from pnpdepth_cli.dataset.frame_record import BatchState, FrameRecord
from pnpdepth_cli.errors import InputError, OutputError, PnpDepthError
from pnpdepth_cli.file_record import FileRecord
from pnpdepth_cli.io.atomic import LOCKS, make_folder
from pnpdepth_cli.io.file_bytes import fingerprint, is_unchanged, plain, read_bytes
from pnpdepth_cli.models.definition import file_and_part
from pnpdepth_cli.version import __version__

_IMAGES = ("preview", "improvement")
"""Kinds of outputs for a person, which may be deleted."""
_NO_SETTINGS = (
    "name",
    "group",
    "image",
    "sparse",
    "sparse_mask",
    "gt",
    "masks",
    "calib",
    "extrinsics",
    "pose",
    "neighbours",
    "model",
    "more_models",
    "checkpoint",
    "output",
    "overwrite",
    "view_3d",
    "is_first",
)
"""Fields that say where something lies, whose content is compared instead, or that add a file or a
line."""
_OWN_SUMMARY = b'{\n  "command": "batch"'
"""Beginning of a summary.json that a batch wrote."""
_POSE_DECIMALS = 6
"""Decimals of a pose that count as a setting: a micrometre, as processors round differently."""


class Records:
    """The records of frames that are refined alike, in the output folder of a batch.

    Args:
        request: The batch; its network and code are taken as they are now.
    """

    def __init__(self, request: BatchRequest) -> None:
        self.request = request
        self.settings = _settings_of(request.refine) | _code_of(request.refine)
        """What decides the results."""

    def outputs_of(self, frame: FrameFiles) -> Outputs:
        """Returns the files of a frame's result, by kind."""
        return self.request.refine.outputs_in(self.request.output, frame.name)

    def check_new(self, frames: Iterable[FrameFiles]) -> None:
        """Raises OutputError if no batch has written to the folder, and a result exists there."""
        output = self.request.output
        # A batch wrote there if its summary is there, or its lock, which is there from the start.
        with suppress(InputError):  # there is no summary, or it cannot be read
            if read_bytes(output / JSON).startswith(_OWN_SUMMARY):
                return
        if any(output.glob(LOCKS)):
            return
        results = (path for frame in frames for path in self.outputs_of(frame).values())
        for path in (output / CSV, output / JSON, *results):
            if path.exists():
                raise OutputError(
                    f"{path} exists, and no batch wrote it; --overwrite replaces such files, -o"
                    " names another folder"
                )

    def find(self, frame: FrameFiles) -> FrameRecord | str:
        """Returns the record of a frame with its present settings, or in a few words why not."""
        outputs = self.outputs_of(frame)
        if not outputs["record"].exists():
            # The record is removed before the other files are written again.
            return "interrupted" if any(path.exists() for path in outputs.values()) else "new"
        try:
            record = FrameRecord.read(outputs["record"])
        except InputError:
            return "record damaged"
        present = self._digest(request_of(self.request, frame))
        if record.batch is None or record.batch.settings != present:
            return "other settings"
        return record

    def reason_to_refine(self, frame: FrameFiles) -> str | None:
        """Returns in a few words why a frame is to be refined; None if it is done.

        It is done if it has a result with its present settings and files.
        """
        record = self.find(frame)
        if isinstance(record, str):  # why there is no record
            return record
        if record.batch is None or record.status == "failed":
            return "failed before"
        # The files that were read, and those that were written.
        inputs = dict(input_files(request_of(self.request, frame)))
        read = record.batch.inputs
        if read.keys() != inputs.keys():
            return "other input files"
        if not all(is_unchanged(path, read[name]) for name, path in inputs.items()):
            return "input changed"
        written = [path for kind, path in self.outputs_of(frame).items() if kind not in _IMAGES]
        return None if all(path.exists() for path in written) else "result missing"

    def state(self, request: RefineRequest) -> BatchState:
        """Returns by what a frame is known to be done: its settings, and its files as they are.

        Args:
            request: What is asked of the frame.

        Raises:
            InputError: A file cannot be read.
        """
        inputs = {name: fingerprint(path) for name, path in input_files(request)}
        return BatchState(settings=self._digest(request), inputs=inputs)

    def fail(self, request: RefineRequest, error: Exception | None) -> FrameRecord:
        """Writes a record that says why a frame failed, and returns it.

        Args:
            request: What was asked of the frame.
            error: What ended it. One that is no `PnpDepthError` is a bug, and said to be one.
        """
        files = request.files
        message = str(error)
        if error is not None and not isinstance(error, PnpDepthError):
            # Where it was raised, as no traceback is kept.
            line = traceback.extract_tb(error.__traceback__)[-1]
            where = f"{Path(line.filename).name}, line {line.lineno}"
            message = f"a bug of pnpdepth: {type(error).__name__}: {error} ({where})"
        record = FrameRecord(
            name=files.name,
            group=files.group,
            status="failed",
            message=message,
            batch=BatchState(settings=self._digest(request)),
            inputs={name: FileRecord(path=str(path)) for name, path in input_files(request)},
        )
        path = self.outputs_of(files)["record"]
        make_folder(path.parent, below=self.request.output)
        record.write(path)
        return record

    def _digest(self, request: RefineRequest) -> str:
        """The SHA-256 of all settings of a frame; two frames with the same were refined alike."""
        settings = self.settings | _settings_of(request)
        pose = request.files.pose
        if pose is not None:
            # + 0.0 makes 0 of −0, which JSON tells apart.
            settings["pose"] = [
                [round(number, _POSE_DECIMALS) + 0.0 for number in row] for row in pose
            ]
        text = json.dumps(settings, sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()


def _settings_of(request: RefineRequest) -> dict[str, object]:
    """The settings that change a frame's result if they change, but no files, by their names."""
    # All fields of the request and its groups, side by side.
    fields = dict[str, object]()
    for name, value in vars(request).items():
        if name in GROUPS:
            fields |= vars(value)
        else:
            fields[name] = value
    settings = {name: value for name, value in fields.items() if name not in _NO_SETTINGS}
    # Neighbours and scans name files besides their settings; only the settings are taken.
    neighbours = request.files.neighbours
    if neighbours:
        settings["neighbours"] = [(neighbour.motion, neighbour.apart) for neighbour in neighbours]
    scan = asdict(request.reading.scan)
    settings["scan"] = {name: value for name, value in scan.items() if name not in _NO_SETTINGS}
    # Devices of one kind give equal results, so shards may use one each.
    settings["device"] = request.device.split(":")[0]
    return dict(plain(settings))


def _code_of(request: RefineRequest) -> dict[str, object]:
    """The program's version, and names and digests of the networks' and the user's own files."""
    # A setting such as the loss may be a Python file of the user's.
    names = [name for name in vars(request.method).values() if isinstance(name, str)]
    user_files = [name for name in names if name.endswith(".py")]
    files = [_identity(spec) for spec in (request.model, *request.more_models, *user_files)]
    name_of_model, _ = files[0]
    checkpoint = request.checkpoint
    return {
        "version": __version__,
        "model": name_of_model,
        "files": files,
        "checkpoint": None if checkpoint is None else _identity(str(checkpoint)),
    }


def _identity(spec: str) -> tuple[str, str | None]:
    """The name and the SHA-256 of a file; the spec and None if it names no file.

    The name has no folder, so that a batch may be moved. Of FILE:PART it keeps the part.

    Args:
        spec: FILE, FILE:PART, or another name, such as that of a network.
    """
    path, part = file_and_part(Path(spec))
    if not path.exists():
        return spec, None
    name = f"{path.name}:{part}" if part else path.name
    return name, fingerprint(path).sha256
