"""The record beside a result is the state of a batch: how the result was made, and of which files.

`NAME.json` is written last, by rename, and removed before the files of `NAME` are written again.
Its entry `batch` holds the digest of the settings and what identifies the inputs.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterable, Mapping
from dataclasses import fields
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

from pnpdepth_cli import __version__
from pnpdepth_cli.commands.batch.batch_request import BatchRequest
from pnpdepth_cli.commands.batch.find_frames import CSV, JSON, input_files, request_of
from pnpdepth_cli.commands.refinement.output_files import IMAGES, Outputs, outputs_in
from pnpdepth_cli.commands.refinement.refine_request import RefineRequest
from pnpdepth_cli.dataset.frame_files import FrameFiles
from pnpdepth_cli.dataset.frame_record import BatchState, FrameRecord
from pnpdepth_cli.errors import FileFormatError, OutputError
from pnpdepth_cli.file_record import FileRecord
from pnpdepth_cli.io.atomic import LOCKS, cannot_write, make_folder, remove_leftovers
from pnpdepth_cli.io.file_bytes import Fingerprint, is_unchanged, parse_json, plain, sha256_of
from pnpdepth_cli.models.definition import file_and_part

_OWN_SUMMARY = b'{\n  "command": "batch"'


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
        """Returns the files of a frame's result."""
        output, refine = self.request.output, self.request.refine
        return outputs_in(output, frame.name, refine, with_gt=frame.gt is not None)

    def check_new(self, frames: Iterable[FrameFiles]) -> None:
        """Raises OutputError if no batch has written to the folder, and a result exists there."""
        output = self.request.output
        names = [path.name for path in output.iterdir()] if output.exists() else []
        own = JSON in names and (_content(output / JSON) or b"").startswith(_OWN_SUMMARY)
        if own or not names or any(fnmatch(name, LOCKS) for name in names):
            return
        results = (path for frame in frames for path in self.outputs_of(frame).values())
        for path in (output / CSV, output / JSON, *results):
            if path.exists():
                raise OutputError(
                    f"{path} exists, and no batch wrote it; --overwrite replaces such files, -o"
                    " names another folder"
                )

    def reason_to_refine(self, frame: FrameFiles) -> str | None:
        """Returns why a frame is to be refined; None if it is done with its settings and files."""
        # The record.
        request, outputs = request_of(self.request, frame), self.outputs_of(frame)
        if not outputs["record"].exists():
            return "interrupted" if any(path.exists() for path in outputs.values()) else "new"
        record = _read(outputs["record"])
        if record is None:
            return "record damaged"
        if record.status == "failed" and record.batch is not None:
            return "failed before"
        if record.batch is None or record.batch.settings != self._digest(request):
            return "other settings"
        # The files that were read, and those that were written.
        inputs, known = dict(input_files(request)), record.batch.inputs
        if known.keys() != inputs.keys():
            return "other input files"
        if not all(is_unchanged(path, known[part]) for part, path in inputs.items()):
            return "input changed"
        there = all(path.exists() for kind, path in outputs.items() if kind not in IMAGES)
        return None if there else "result missing"

    def record_of(self, frame: FrameFiles) -> FrameRecord | None:
        """Returns the record of a frame with its present settings; None if there is none."""
        record = _read(self.outputs_of(frame)["record"])
        if record is None or record.batch is None:
            return None
        present = self._digest(request_of(self.request, frame))
        return record if record.batch.settings == present else None

    def state(self, request: RefineRequest, inputs: Mapping[str, Fingerprint]) -> BatchState:
        """Returns by what a frame is known to be done: its settings, and the files by part."""
        return BatchState(settings=self._digest(request), inputs=dict(inputs))

    def fail(self, request: RefineRequest, message: str) -> FrameRecord:
        """Writes a record that says why a frame failed, and returns it."""
        files = request.files
        record = FrameRecord(
            name=files.name,
            group=files.group,
            status="failed",
            message=message,
            batch=self.state(request, {}),
            inputs={part: FileRecord(path=str(path)) for part, path in input_files(request)},
        )
        path = self.outputs_of(files)["record"]
        make_folder(path.parent, below=self.request.output)
        record.write(path)
        return record

    def _digest(self, request: RefineRequest) -> str:
        """The SHA-256 of the settings that decide the frame's result."""
        own = _settings_of(request, "files", "reading")  # by which frames of a batch differ
        if request.files.pose is not None:  # to a micrometre, as processors round differently
            own["pose"] = [[round(value, 6) + 0.0 for value in row] for row in request.files.pose]
        text = json.dumps(self.settings | own, sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()


def _settings_of(request: RefineRequest, *groups: str) -> dict[str, object]:
    """The settings of these groups, or all, that decide a frame's result, in JSON's own types."""
    values = request.settings(*groups)
    values.pop("more_models", None)
    if neighbours := values.pop("neighbours", None):
        values["neighbours"] = [(other.motion, other.apart) for other in neighbours]
    if "device" in values:  # devices of one kind give equal results, so shards may use one each
        values["device"] = values["device"].split(":")[0]
    settings: dict[str, Any] = plain(values)
    for name in ("calib", "extrinsics"):  # files are compared by their content elsewhere
        settings.get("scan", {}).pop(name, None)
    return settings


def _code_of(request: RefineRequest) -> dict[str, object]:
    """The program's version, and the digests of the network's files and of the user's code."""
    network, method = request.network, request.method
    identity = {"version": __version__, **_identity(network.model), "checkpoint": None}
    if network.checkpoint is not None:
        file, key = file_and_part(network.checkpoint)
        identity |= {"checkpoint": sha256_of(file)} | ({"state_dict": key} if key else {})
    if more := [_identity(spec) for spec in network.more_models]:
        identity["more_models"] = more
    # Python files among the settings, such as of --loss.
    values = (getattr(method, field.name) for field in fields(method))
    files = {value for value in values if isinstance(value, str) and value.endswith(".py")}
    if files:
        identity["code"] = {file: sha256_of(Path(file)) for file in sorted(files)}
    return identity


def _identity(spec: str) -> dict[str, object]:
    """A network's name with its :ATTRIBUTE, :OUTPUT or :KEY, without the folder of a file."""
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
