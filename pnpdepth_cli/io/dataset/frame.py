"""One frame of a data set: its files, what is needed to read them, and its name."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from pnpdepth_cli.errors import FileFormatError
from pnpdepth_cli.io.calibration import Calibration
from pnpdepth_cli.io.dataset.protocols import WHOLE, Protocol

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".exr")
SCAN_ONLY_SUFFIXES = (".bin", ".pcd", ".ply")

_LONGEST_PART = 255 - len("_improvement.png")
"""Bytes of a part of a name, so that the longest file name of a result has 255."""

_LEADS_OUT = "leads out of the output folder"
_DRIVE = re.compile(r"[A-Za-z]:")
_RESERVED = re.compile(r"(con|prn|aux|nul|com[0-9¹²³]|lpt[0-9¹²³])\s*(\..*)?", re.IGNORECASE)
"""Device names that Windows reserves in every folder, with any suffix."""


@dataclass(frozen=True, kw_only=True)
class Hdf5Array:
    """An array in an HDF5 or MATLAB 7.3 file."""

    path: Path
    name: str
    focal_px: float | None = None
    """For depth that is the distance from the camera's centre: the focal length, with the principal
    point in the middle, to get z. None for z itself."""
    axes: tuple[int, ...]
    """Order of the axes that makes the array, without its indexed axis, (H, W) or (H, W, 3)."""
    index: int | None = None
    """Which element of the first axis; None for the whole array."""

    def __str__(self) -> str:
        return f"{self.path}[{self.name}{'' if self.index is None else f', {self.index}'}]"


Source = Path | Hdf5Array


def file_of(source: Source) -> Path:
    """Returns the file that a source lies in."""
    return source if isinstance(source, Path) else source.path


Pose = tuple[tuple[float, ...], ...]
"""(3, 4): rotation and, in the last column, translation in metres."""


@dataclass(frozen=True, kw_only=True)
class Neighbour:
    """Another frame of the same sequence, whose points are moved into this one."""

    frame: Frame
    motion: Pose | None
    """(3, 4) from the other camera's frame to this one's, metres. None: to be estimated."""
    poses: str
    """Where the motion is from, for a person."""
    apart: int
    """Frames between the two, at least 1."""


@dataclass(frozen=True, kw_only=True)
class Frame:
    """One frame; parts that it does not have are None."""

    name: str
    """Unique in its data set, and fit for a file name; slashes separate folders."""
    image: Source | None = None
    sparse: Path | None = None
    """A depth file, a list of points, or a scan; None where points are sampled from `gt`."""
    gt: Source | None = None
    calib: Path | None = None
    """The calibration, as `read_calibration` takes it."""
    camera: int | None = None
    """Which camera of the calibration."""
    calibration: Calibration | None = None
    """The calibration itself, of a data set that has one for each frame and no file of it."""
    sparse_scale: float | None = None
    """Codes per metre of integer sparse depth."""
    gt_scale: float | None = None
    """Codes per metre of integer ground truth."""
    protocol: Protocol = WHOLE
    """The part of the frame that is used."""
    pose: Pose | None = None
    """x_world = pose · (x, 1) for points in the camera's frame; of KITTI odometry camera 0's."""
    oxts: Path | None = None
    """The packet of KITTI's inertial system that gives the pose."""
    neighbours: tuple[Neighbour, ...] = ()
    """Other frames whose points are moved into this one."""
    window: tuple[Frame, ...] = ()
    """The frames of its window up to and with this one; empty outside of windows."""
    masks: tuple[Path, ...] = ()
    """Images or arrays of the ground truth's size; where one is 0, the ground truth is unknown."""
    gt_other_size: bool = False
    """Whether the ground truth may have another size than the image, of the same view."""
    sparse_other_size: bool = False
    """The same for the sparse depth."""
    group: str | None = None
    """The sequence it belongs to; None derives it from the name."""

    def __post_init__(self) -> None:
        for source in (self.image, self.sparse, self.gt, self.calib, *self.masks):
            if source is not None:
                _check_no_nul(file_of(source))


@dataclass(frozen=True, kw_only=True)
class Unmatched:
    """A file or folder that belongs to no frame."""

    path: Path
    why: str
    """The reason, as the end of a sentence that begins with the path."""

    def __post_init__(self) -> None:
        _check_no_nul(self.path)

    def __str__(self) -> str:
        return f"{self.path} {self.why}"


@dataclass(frozen=True, kw_only=True)
class Listing:
    """What a data set holds."""

    frames: Sequence[Frame]
    """Complete frames, in a fixed order."""
    broken: tuple[Unmatched, ...] = ()
    """Files of frames that lack a part, or cannot be read."""
    spare: tuple[Unmatched, ...] = ()
    """Other files beside them."""


def _check_no_nul(path: Path) -> None:
    """Raises FileFormatError for a path that no file can have: an index file may hold any text."""
    if "\0" in str(path):
        name = str(path).replace("\0", "\\0")
        raise FileFormatError(f"{name}: a file name holds a NUL character; correct the file's list")


def normalised_name(name: str) -> str:
    """Returns the name without "./" and double slashes: what its files would be called."""
    return name if PurePosixPath(name).is_absolute() else PurePosixPath(name).as_posix()


def name_problem(name: str) -> str | None:
    """Returns why no result can be stored under a frame's name on POSIX; None if it can.

    The reason is a predicate, such as "holds a NUL character".
    """
    if "\0" in name:
        return "holds a NUL character"
    path = PurePosixPath(name)
    if path.is_absolute() or ".." in path.parts:
        return _LEADS_OUT
    if not path.parts:
        return "names no file"
    if any(len(part.encode("utf-8", "surrogateescape")) > _LONGEST_PART for part in path.parts):
        return f"is longer than {_LONGEST_PART} bytes"
    return None


def portable_name_problem(name: str) -> str | None:
    """Returns why a name is not fit for results on Linux, macOS or Windows; None if it is."""
    if "\\" in name:
        return "holds a backslash, which separates folders on Windows only; use /"
    if _DRIVE.match(name):
        return "begins with a drive letter"
    for part in PurePosixPath(name).parts:
        if _RESERVED.fullmatch(part):
            return f"holds {part!r}, which Windows reserves"
    problem = name_problem(name)
    return None if problem == _LEADS_OUT else problem  # only what writes results minds
