"""The files of a frame, what is needed to read them, its name, and its cut."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING

from pnpdepth_cli.errors import FileFormatError
from pnpdepth_cli.protocols import WHOLE, FramePart

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".heic", ".exr")
SCAN_ONLY_SUFFIXES = (".bin", ".pcd", ".ply")
VIDEO_SUFFIXES = (".mp4", ".mov")

_LONGEST_PART = 255 - len("_improvement.png")
"""Bytes of a part of a name, so that the longest file name of a result has 255."""

_DRIVE = re.compile(r"[A-Za-z]:")


@dataclass(frozen=True, kw_only=True)
class VideoFrame:
    """A frame of a video."""

    path: Path
    index: int
    """Number of the frame, from 0."""

    def __str__(self) -> str:
        return f"{self.path}[{self.index}]"


ImageSource = Path | VideoFrame


def source_of(text: str) -> Path | VideoFrame:
    """Returns the image that a record names: a file, or a frame of a video."""
    found = re.fullmatch(r"(.*)\[(\d{1,9})\]", text, re.DOTALL)
    if found is None or not found[1].lower().endswith(VIDEO_SUFFIXES):
        return Path(text)
    return VideoFrame(path=Path(found[1]), index=int(found[2]))


def file_of(source: ImageSource) -> Path:
    """Returns the file that a source lies in."""
    return source if isinstance(source, Path) else source.path


Pose = tuple[tuple[float, ...], ...]
"""(3, 4): rotation and, in the last column, translation in metres."""


def as_pose(matrix: NDArray[np.float64]) -> Pose:
    """Returns a (3, 4) matrix as the pose of a frame."""
    return tuple(map(tuple, matrix.tolist()))


@dataclass(frozen=True, kw_only=True)
class Neighbour:
    """Another frame of the same sequence, whose points are moved into this one."""

    files: FrameFiles
    motion: Pose | None  # from the other camera's coordinates to this one's. None: to be estimated.
    poses: str  # where the motion is from, for a person
    apart: int  # frames between the two, at least 1


@dataclass(frozen=True, kw_only=True)
class FrameFiles:
    """The files of one frame; parts that it does not have are None."""

    name: str = ""
    """Unique in its data set, and fit for a file name; slashes separate folders."""
    image: ImageSource | None = None
    sparse: Path | None = None
    """A depth file, a list of points, a scan, or the folder of a COLMAP model. None where points
    are sampled from `gt`."""
    sparse_mask: Path | None = None
    """An image or array, how sure each pixel of `sparse` or of the image is; 0 is no depth."""
    min_confidence: float | None = None  # least value of `sparse_mask` whose depth is used
    gt: Path | None = None
    calib: Path | None = None  # the calibration, as `read_calibration` takes it
    camera: int | None = None  # which camera of the calibration
    sparse_scale: float | None = None  # codes per metre of integer sparse depth
    gt_scale: float | None = None  # codes per metre of integer ground truth
    part: FramePart = WHOLE
    pose: Pose | None = None
    """x_world = pose · (x, 1) for x in the camera's coordinates, in KITTI odometry camera 0's."""
    neighbours: tuple[Neighbour, ...] = ()
    masks: tuple[Path, ...] = ()
    """Images or arrays of the ground truth's size; where one is 0, the ground truth is unknown."""
    gt_other_size: bool = False
    """Whether the ground truth may have another size than the image, of the same view."""
    one_view: bool = False
    """Whether the data set says that image and depth are of one view, pixel by pixel."""
    group: str | None = None  # the sequence it belongs to; None derives it from the name

    def __post_init__(self) -> None:
        for source in (self.image, self.sparse, self.sparse_mask, self.gt, self.calib, *self.masks):
            if source is not None:
                _check_path(file_of(source))

    @property
    def image_file(self) -> Path | None:
        """The file of the image; None for none, or for a frame of a video."""
        return self.image if isinstance(self.image, Path) else None


@dataclass(frozen=True, kw_only=True)
class Unmatched:
    """A file or folder that belongs to no frame."""

    path: Path
    why: str  # the reason, as the end of a sentence that begins with the path

    def __post_init__(self) -> None:
        _check_path(self.path)

    def __str__(self) -> str:
        return f"{self.path} {self.why}"


def _check_path(path: Path) -> None:
    """FileFormatError for a path that no file can have: an index file may hold any text."""
    if not _can_be_named(str(path)):
        raise FileFormatError(f"{str(path)!r}: no file can have this name; correct the list")


def _can_be_named(text: str) -> bool:
    """Whether a file can have the name."""
    try:
        return b"\0" not in os.fsencode(text)
    except UnicodeEncodeError:
        return False


def find_files(folder: Path, suffixes: tuple[str, ...]) -> tuple[dict[str, Path], list[Unmatched]]:
    """Returns the files with one of these suffixes, by relative path without suffix, and problems.

    Links are followed, except into a folder that they lie in. Hidden files and folders are skipped.
    Files are in natural order of their paths. Problems are folders that cannot be read, and files
    that differ in suffix only, which are left out. The folder need not exist.
    """
    problems: list[Unmatched] = []
    walked = _walk(folder, frozenset(), problems) if folder.is_dir() else ()
    paths = sorted(walked, key=lambda path: natural_order(path.as_posix()))
    files, ambiguous = one_of_each(
        (path.relative_to(folder).with_suffix("").as_posix(), path)
        for path in paths
        if path.suffix.lower() in suffixes
    )
    return files, problems + ambiguous


def natural_order(name: str) -> list[tuple[int, str]]:
    """Returns the key by which names are sorted as a person does: a2 before a10."""
    return [(int(part) if part.isdecimal() else 0, part) for part in re.split(r"(\d+)", name)]


def one_of_each(
    named: Iterable[tuple[str, Path]],
) -> tuple[dict[str, Path], list[Unmatched]]:
    """Returns the files whose name no other file has, by name, and the others."""
    files: dict[str, list[Path]] = {}
    for name, path in named:
        files.setdefault(name, []).append(path)
    ambiguous = [
        Unmatched(path=path, why=f"and {paths[0].name} are one frame; keep one")
        for paths in files.values()
        for path in paths[1:]
    ]
    return {name: paths[0] for name, paths in files.items() if len(paths) == 1}, ambiguous


def _walk(folder: Path, above: frozenset[str], problems: list[Unmatched]) -> Iterator[Path]:
    real = os.path.realpath(folder)
    if real in above:
        return  # a link to a folder that it is in
    try:
        paths = [path for path in folder.iterdir() if not path.name.startswith(".")]
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        why = f"cannot be read ({reason}); what is in it is left out"
        problems.append(Unmatched(path=folder, why=why))
        return
    for path in paths:
        if path.is_dir():
            yield from _walk(path, above | {real}, problems)
        elif path.is_file():
            yield path


def name_problem(name: str) -> str | None:
    """Returns why no result can be stored under a frame's name; None if it can.

    The reason is a predicate, such as "names no file".
    """
    if not _can_be_named(name):
        return "holds a character that no file name has"
    path = PurePosixPath(name)
    if path.is_absolute() or ".." in path.parts:
        return "leads out of the output folder"
    if "\\" in name or _DRIVE.match(name):
        return "holds a backslash or a drive letter, which lead out of the folder on Windows"
    if not path.parts:
        return "names no file"
    if any(len(part.encode("utf-8", "surrogateescape")) > _LONGEST_PART for part in path.parts):
        return f"is longer than {_LONGEST_PART} bytes"
    return None


_FRAME_NUMBER = re.compile(r"(?:^|[_\-/])\d+(?:_image_\d+)?$")


def groups_by_name(names: Sequence[str]) -> list[str]:
    """Returns the sequence of each frame: its name before the frame number, or else its folder.

    `drive_0002_sync_0000000008_image_02` is of `drive_0002_sync`, and `office/0012` of `office`.
    Unless all names end in a number, only folders make groups.
    """
    stems = [_FRAME_NUMBER.sub("", name) for name in names]
    if all(stem != name for stem, name in zip(stems, names, strict=True)):
        return stems
    return [name.rpartition("/")[0] for name in names]
