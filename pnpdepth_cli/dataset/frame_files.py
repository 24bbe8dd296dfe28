"""The files of a frame, its name, and how they are read. Imports neither numpy nor torch."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING

from pnpdepth_cli import choices
from pnpdepth_cli.errors import InputError, UsageError
from pnpdepth_cli.file_record import SamplePattern
from pnpdepth_cli.protocols import WHOLE, ForegroundFilter, FramePart
from pnpdepth_cli.settings import option

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

# Suffixes of files, in lower case.
IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".heic", ".exr")
SCAN_ONLY_SUFFIXES = (".bin", ".pcd", ".ply")
VIDEO_SUFFIXES = (".mp4", ".mov")

_LONGEST_PART = 255 - len("_improvement.png")
"""Bytes of a part of a name, so that the longest file name of a result has 255."""
_DRIVE = re.compile(r"[A-Za-z]:")
"""Beginning of a path on Windows."""


@dataclass(frozen=True, kw_only=True)
class VideoFrame:
    """A frame of a video."""

    path: Path
    index: int
    """Number of the frame, from 0."""

    def __str__(self) -> str:
        """VIDEO[NUMBER], which `source_of` reads."""
        return f"{self.path}[{self.index}]"


ImageSource = Path | VideoFrame


def source_of(text: str) -> Path | VideoFrame:
    """Returns the image that a record names: a file, or a frame of a video as VIDEO[NUMBER]."""
    match = re.fullmatch(r"(.*)\[(\d{1,9})\]", text, re.DOTALL)
    if match is None or not match[1].lower().endswith(VIDEO_SUFFIXES):
        return Path(text)
    return VideoFrame(path=Path(match[1]), index=int(match[2]))


def file_of(source: ImageSource) -> Path:
    """Returns the file of an image: itself, or the video that it is a frame of."""
    return source if isinstance(source, Path) else source.path


Pose = tuple[tuple[float, ...], ...]
"""(3, 4): rotation and, in the last column, translation in metres."""


def as_pose(matrix: NDArray[np.float64]) -> Pose:
    """Returns a (3, 4) matrix as tuples of numbers, which can be compared and hashed."""
    return tuple(map(tuple, matrix.tolist()))


@dataclass(frozen=True, kw_only=True)
class Neighbour:
    """Another frame of the same sequence, whose points are moved into this one."""

    files: FrameFiles
    motion: Pose | None
    """From the other camera's coordinates to this one's. None: to be estimated from the images."""
    poses: str
    """Where the motion is from, for a person."""
    apart: int
    """How many frames later or earlier the other one is, at least 1."""


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
    depths: tuple[Path, ...] = ()
    """Depth maps that networks predicted for the image; FILE:KEY names a part of one."""
    gt: Path | None = None
    calib: Path | None = None  # the calibration, as `read_calibration` takes it
    camera: int | None = None  # which camera of the calibration
    sparse_scale: float | None = None  # codes per metre of integer sparse depth
    gt_scale: float | None = None  # codes per metre of integer ground truth
    scales_stated: bool = field(default=False, compare=False)
    """Whether the user states the scales of these very files, so that floats are divided, too."""
    kind_of_sparse: str | None = None  # what `sparse` holds, as `ReadOptions.sparse_kind`
    kind_of_gt: str | None = None  # what `gt` holds
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
    is_first: bool = field(default=True, compare=False)
    """Whether it is one of the first of its sequence, of which it is searched how image and points
    belong together."""

    def __post_init__(self) -> None:
        """Raises InputError for a path that no file can have."""
        sources = (self.image, self.sparse, self.sparse_mask, self.gt, self.calib)
        for source in (*sources, *self.depths, *self.masks):
            if source is not None:
                check_path(file_of(source))

    @property
    def image_file(self) -> Path | None:
        """The file of the image; None for none, or for a frame of a video."""
        return self.image if isinstance(self.image, Path) else None


@dataclass(frozen=True, kw_only=True)
class ScanOptions:
    """How a scan is projected to sparse depth of an image."""

    calib: Path | None = option(
        None,
        "Calibration of a LiDAR scan: KITTI, OpenCV, ROS, Kalibr, or a file with K, R, t.",
        metavar="FILE|FOLDER",
    )
    extrinsics: Path | None = option(
        None,
        "Pose of the scanner in the camera's coordinates: matrix, quaternion or tf.",
        metavar="FILE",
    )
    camera: int | None = option(
        None, "Camera number of KITTI (0 to 3) or Kalibr.  [default: 2; 0]", metavar="N"
    )
    keep_occluded: bool = False
    """Whether points that are occluded from the camera stay."""

    def over(self, files: FrameFiles) -> ScanOptions:
        """Returns these options, with the calibration and camera that the data set names.

        What the user states goes before.

        Args:
            files: Files of the frame, which name them.
        """
        calib = self.calib or files.calib
        if calib is None:
            return self
        camera = files.camera if self.camera is None else self.camera
        return replace(self, calib=calib, camera=camera)


@dataclass(frozen=True, kw_only=True)
class ReadOptions:
    """What the user says of the files of a frame, over what the data set says."""

    depth_scale: float | None = option(
        None,
        "Depth files hold metres × S; beside a file of integers, float files hold metres."
        "  [default: from the file, else 256; of floats 1]",
        metavar="S",
    )
    unit_scale: float | None = option(
        None, "Metres per unit of a COLMAP model.  [default: depth is in model units]", metavar="M"
    )
    sparse_range: bool = option(
        False, "Sparse depth is the distance from the camera, not depth z; needs --calib."
    )
    sparse_kind: str | None = option(
        None,
        "What sparse depth holds: inverse, 1/z; or disparity:B in pixels, with B = baseline in"
        " metres × focal length in pixels.  [default: depth z]",
        metavar="KIND",
    )
    registration: str = option(
        "auto",
        "Whether the image is moved to the points: auto, if their depth edges show"
        " that it is not registered; or off.",
        choices=choices.REGISTRATIONS,
    )
    scan: ScanOptions = field(default_factory=ScanOptions)
    sample: SamplePattern | None = None
    """Which points of the ground truth are the sparse depth. None: the frame's own sparse depth."""
    foreground: ForegroundFilter | None = None
    """Which points of a depth map are removed. None: the program's own choice."""

    def __post_init__(self) -> None:
        """Raises UsageError for a scale that is not above 0, or an unknown kind of depth."""
        if self.unit_scale is not None and not 0 < self.unit_scale < math.inf:
            raise UsageError(f"--unit-scale must be above 0, got {self.unit_scale:g}")
        inverse_factor("--sparse-kind", self.sparse_kind)


def inverse_factor(option: str, kind: str | None) -> float | None:
    """Returns the constant that depth × number is in a file of 1/depth or disparity.

    Args:
        option: Option, or column of a list, that states the kind; for messages.
        kind: "depth" or None; "inverse", which is 1/depth in 1/m; or "disparity:B", which is
            disparity in pixels, with B in metres × pixels.

    Returns:
        1 of "inverse", and B of "disparity:B". None for depth itself.

    Raises:
        UsageError: There is no such kind.
    """
    if kind in (None, "depth"):
        return None
    if kind == "inverse":
        return 1.0
    name, _, number = str(kind).partition(":")
    try:
        factor = float(number)
    except ValueError:  # no number, which the next line refuses
        factor = math.nan
    if name != "disparity" or not 0 < factor < math.inf:
        raise UsageError(
            f"{option} is depth, inverse, or disparity:B with the baseline in metres × the focal"
            f" length in pixels, such as disparity:386.1, not {kind!r}"
        )
    return factor


Unmatched = tuple[Path, str]
"""A file or folder that belongs to no frame, and the reason: the end of a sentence that its path
begins."""


def check_path(path: Path) -> None:
    """Raises InputError for a path that no file can have, as a list may hold any text."""
    if not _can_be_named(str(path)):
        raise InputError(f"{str(path)!r}: no file can have this name; correct the list")


def _can_be_named(text: str) -> bool:
    """Whether a file can have the name: no zero byte, and no character that cannot be encoded."""
    try:
        return b"\0" not in os.fsencode(text)
    except UnicodeEncodeError:  # such as of half a surrogate pair
        return False


def find_files(folder: Path, suffixes: tuple[str, ...]) -> tuple[dict[str, Path], list[Unmatched]]:
    """Returns the files with one of these suffixes, in a folder and below, and what is left out.

    Links are followed, except into a folder that they lie in. Hidden files and folders are skipped.

    Args:
        folder: The folder, which need not exist.
        suffixes: Suffixes in lower case, with their dots.

    Returns:
        The files by their path below the folder, without suffix, in natural order; and folders that
        cannot be read, and files that differ in suffix only.
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
    return [(int(run) if run.isdecimal() else 0, run) for run in re.split(r"(\d+)", name)]


def one_of_each(named: Iterable[tuple[str, Path]]) -> tuple[dict[str, Path], list[Unmatched]]:
    """Returns the files whose name no other file has, by name; and files that share a name.

    Args:
        named: Names of frames, each with a file.

    Returns:
        Of files that share a name, all but the first are listed, and none is among the files.
    """
    paths_by_name: dict[str, list[Path]] = {}
    for name, path in named:
        paths_by_name.setdefault(name, []).append(path)
    ambiguous = [
        (path, f"and {paths[0].name} are one frame; keep one")
        for paths in paths_by_name.values()
        for path in paths[1:]
    ]
    files = {name: paths[0] for name, paths in paths_by_name.items() if len(paths) == 1}
    return files, ambiguous


def _walk(folder: Path, above: frozenset[str], problems: list[Unmatched]) -> Iterator[Path]:
    """Yields the files in a folder and below, in no order, without hidden ones.

    Args:
        folder: The folder.
        above: Real paths of the folders that it was reached through.
        problems: List to which folders are added that cannot be read.
    """
    real = os.path.realpath(folder)
    if real in above:
        return  # a link to a folder that it is in
    try:
        paths = [path for path in folder.iterdir() if not path.name.startswith(".")]
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        problems.append((folder, f"cannot be read ({reason}); what is in it is left out"))
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
    if any(len(folder.encode("utf-8", "surrogateescape")) > _LONGEST_PART for folder in path.parts):
        return f"is longer than {_LONGEST_PART} bytes"
    return None


_FRAME_NUMBER = re.compile(r"(?:^|[_\-/])\d+(?:_image_\d+)?$")
"""End of a frame's name; KITTI's depth benchmark has the camera's number behind it."""


def groups_of(names: Sequence[str], stated: Sequence[str | None]) -> list[str]:
    """Returns the sequence of each frame: the one that the data set states, else by its name.

    That is its name before the frame number, or else its folder: of `drive_02_sync_008_image_02`
    it is `drive_02_sync`, of `office/0012` `office`. Unless all names end in a number, only folders
    make groups; a frame in none has an empty group.

    Args:
        names: Names of the frames.
        stated: Sequence of each that the data set states. None: it states none.
    """
    groups = [_FRAME_NUMBER.sub("", name) for name in names]
    if any(group == name for group, name in zip(groups, names, strict=True)):
        groups = [name.rpartition("/")[0] for name in names]
    return [of_data_set or group for of_data_set, group in zip(stated, groups, strict=True)]
