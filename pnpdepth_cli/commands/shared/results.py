"""The frames that `refine` or `batch` wrote: depth files with their records and masks."""

from __future__ import annotations

import functools
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.camera import Camera
from pnpdepth_cli.commands.requests.refine_request import endings_of
from pnpdepth_cli.dataset.frame_files import ImageSource, file_of, find_files, source_of
from pnpdepth_cli.dataset.frame_record import FrameRecord, Pose
from pnpdepth_cli.errors import InputError
from pnpdepth_cli.io.depth import DEPTH_SUFFIXES, read_depth
from pnpdepth_cli.io.file_bytes import read_json
from pnpdepth_cli.io.rgb import read_rgb

_DEPTH = "_depth"
"""End of the stem of a depth file."""
_MARKS = {"schema", "versions", "status"}
"""Entries of which a record of any version of this program has one."""


@dataclass(frozen=True, kw_only=True)
class ResultFrame:
    """The files of one depth map."""

    name: str
    """Path below the folder of the results, without the ending."""
    depth: Path
    """The depth file."""
    sigma: Path | None = None
    """The file of the depth's standard deviation. None: there is none."""
    valid: Path | None = None
    """The mask of valid depth. None: there is none, and all known depth is valid."""
    record: FrameRecord = field(default_factory=FrameRecord)
    """The record beside the depth; an empty one where there is none."""

    @property
    def image(self) -> ImageSource | None:
        """The image that the record names, if it exists."""
        entry = self.record.inputs.get("image")
        image = None if entry is None else source_of(entry.path)
        return image if image is not None and file_of(image).is_file() else None

    @property
    def lost_image(self) -> str:
        """Why there is no image. Paths of a record start where the command ran."""
        entry = self.record.inputs.get("image")
        if entry is None:
            return "no image is known"
        return f"{entry.path} is not found from {Path.cwd()}; run this in the folder of `refine`"

    @property
    def size(self) -> tuple[int, int] | None:
        """(H, W) of the depth, as the record has it. None: unknown."""
        result = self.record.result
        return None if result is None else (result.size[1], result.size[0])

    @functools.cached_property
    def camera_and_pose(self) -> tuple[Camera | None, Pose | None]:
        """The camera that the record holds, and its pose. Raises InputError if damaged."""
        result = self.record.result
        if result is None or result.camera is None:
            return None, None
        try:
            return result.camera.read()
        except ValueError as error:
            raise InputError(
                f"{self.depth}: the camera in the record beside it is damaged; refine it again"
            ) from error

    def read(self, scale: float | None = None) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Returns the (H, W) depth, 0 = unknown, and where it is known and valid.

        Integer depth files hold metres × `scale`; None: their own scale.
        """
        depth = read_depth(self.depth, scale=scale).values
        if self.valid is None:
            return depth, depth > 0
        return depth, (depth > 0) & (self.read_beside(self.valid, depth) > 0)

    def read_beside(self, path: Path, depth: NDArray[np.float32]) -> NDArray[np.float32]:
        """Returns the (H, W) mask, 0 = not valid, or standard deviation that lies beside the depth.

        Args:
            path: `valid` or `sigma`.
            depth: (H, W) the depth, for its size.

        Raises:
            InputError: The file is of another size.
        """
        values = read_rgb(path).values[..., 0] if path == self.valid else read_depth(path).values
        if values.shape != depth.shape:
            raise InputError(f"{path} is not of the size of {self.depth}")
        return values


def result_frames(root: Path) -> list[ResultFrame]:
    """Returns the frame of a depth file, or those of a folder with files NAME_depth.SUFFIX.

    Raises:
        InputError: There is none, or a record cannot be read.
    """
    if not root.is_dir():
        return [_frame(root.stem.removesuffix(_DEPTH), root)]
    files, _ = find_files(root, DEPTH_SUFFIXES)
    frames = [
        _frame(name.removesuffix(_DEPTH), path)
        for name, path in files.items()
        if name.endswith(_DEPTH)
    ]
    if not frames:
        raise InputError(f"{root} has no files NAME{_DEPTH}.png or of another format")
    return frames


def _frame(name: str, depth: Path) -> ResultFrame:
    """The frame of a depth file, with the record, standard deviation and mask beside it."""

    def beside(kind: str) -> Path | None:
        """The file of this kind, as `endings_of` has it, if there is one."""
        path = depth.with_name(depth.stem.removesuffix(_DEPTH) + endings_of(depth.suffix)[kind])
        return path if path != depth and path.is_file() else None

    record = _record(beside("record"))
    companions = {kind: beside(kind) for kind in ("sigma", "valid")}
    if record is not None:
        # Files that the record does not name are of other runs.
        named = {} if record.result is None else record.result.outputs
        companions = {kind: path for kind, path in companions.items() if kind in named}
    return ResultFrame(name=name, depth=depth, record=record or FrameRecord(), **companions)


def _record(path: Path | None) -> FrameRecord | None:
    """The record in a file beside a depth file; None if there is no file.

    The record is empty if another program wrote the file. Raises InputError for one of this program
    that cannot be read.
    """
    if path is None:
        return None
    content = read_json(path)
    if not content.keys() & _MARKS:
        return FrameRecord()
    return FrameRecord.from_json(content, path)
