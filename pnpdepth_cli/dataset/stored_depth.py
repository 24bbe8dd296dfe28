"""The files of sparse depth and of ground truth as they are stored, each read once.

What a file holds is one of two: numbers, of a map or a list of points; or points of a scanner or
of a COLMAP model, which are read together with what projects them. What the numbers mean is
decided afterwards, by functions that take these.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

from pnpdepth_cli.dataset.arrays import raw_depth
from pnpdepth_cli.dataset.frame_files import (
    SCAN_ONLY_SUFFIXES,
    FrameFiles,
    ImageSource,
    ReadOptions,
    ScanOptions,
)
from pnpdepth_cli.dataset.plausible import OF_DATA_SET
from pnpdepth_cli.errors import UsageError
from pnpdepth_cli.io.depth import holds_integers, load_stored
from pnpdepth_cli.io.formats import DepthFile
from pnpdepth_cli.io.point_files import holds_scan, load_numbers

_LIST_SUFFIXES = (".npy", ".csv", ".txt")
"""Suffixes of files whose rows may be x y z of a scan, or x y depth of pixels."""


@dataclass(frozen=True, kw_only=True)
class StoredNumbers:
    """The file of a depth map or a list of points."""

    path: Path
    file: DepthFile
    """The numbers as they are stored, with the unit that the file itself states."""


@dataclass(frozen=True, kw_only=True)
class StoredPoints:
    """The file of a scan, or the folder of a COLMAP model."""

    path: Path
    kind: Literal["scan", "model"]


StoredDepth = StoredNumbers | StoredPoints


class StatedScale(NamedTuple):
    """The scale of a file that the user, or else the data set's layout, states."""

    scale: float | None
    """Numbers per metre. None: nothing is stated."""
    of_integers: str
    """Whose integers the scale is stated of, if not of this file's numbers: path of the frame's
    other file, or `OF_DATA_SET`. Empty: it is stated of this very file."""


def read_stored_sparse(path: Path, scan: ScanOptions) -> StoredDepth:
    """Returns what a file of sparse depth holds: numbers, or points of a scan or a COLMAP model.

    It is a scan by its suffix, or if it holds x y z and there is a calibration. A calibration of
    other sparse depth is that of the camera. A folder is a COLMAP model.

    Args:
        path: The file, or the folder of a COLMAP model.
        scan: The calibration, and what else the user and the data set state of a scan.

    Raises:
        InputError: The file cannot be read.
        UsageError: It is no scan, and an option is given that only a scan has.
    """
    if path.is_dir():
        return StoredPoints(path=path, kind="model")
    suffix = path.suffix.lower()
    if suffix in SCAN_ONLY_SUFFIXES:
        return StoredPoints(path=path, kind="scan")
    # A list with a calibration may hold x y z; if a pose of a scanner is stated, it does.
    numbers = load_numbers(path)
    if scan.calib is not None and suffix in _LIST_SUFFIXES:
        is_stated = scan.extrinsics is not None
        if holds_scan(numbers, is_stated=is_stated):
            return StoredPoints(path=path, kind="scan")
    if scan.extrinsics is not None or (scan.calib is None and scan.camera is not None):
        raise UsageError(
            f"{path} is no scan, so --extrinsics and --camera do not apply; a scan needs --calib"
        )
    return StoredNumbers(path=path, file=numbers)


def read_stored_truth(path: Path, image: ImageSource | None) -> StoredDepth:
    """Returns what a file of ground truth holds: points of a scan by its suffix, or a map.

    Args:
        path: The file.
        image: The image, whose size a depth map without a header has, as in ETH3D. None: there is
            none, and no such map.

    Raises:
        InputError: The file cannot be read.
    """
    if path.suffix.lower() in SCAN_ONLY_SUFFIXES:
        return StoredPoints(path=path, kind="scan")
    depth_without_header = raw_depth(path, image)
    if depth_without_header is not None:
        return StoredNumbers(path=path, file=depth_without_header)
    return StoredNumbers(path=path, file=load_stored(path))


def is_float(stored: StoredDepth) -> bool:
    """Returns whether a file holds floats: a scan, or a map or list whose numbers are floats."""
    if isinstance(stored, StoredPoints):
        return stored.kind == "scan"  # a COLMAP model is in a unit of its own
    return not holds_integers(stored.file)


def scale_of_sparse(
    files: FrameFiles, options: ReadOptions, truth: StoredDepth | None
) -> StatedScale:
    """Returns the scale that is stated of the sparse depth, and of whose numbers it is stated.

    `--depth-scale` is of both files of a frame, but of the integers alone if one of them holds
    integers. What a layout states is of integers only.

    Args:
        files: The files of the frame, with the scales that the data set states.
        options: Options with `--depth-scale`, which goes before.
        truth: What the file of the ground truth holds. None: there is none.
    """
    if options.depth_scale is None:
        return _scale_of_layout(files, files.sparse_scale)
    # Integers of ground truth whose own file states another scale keep that: then what the user
    # states is of the sparse depth.
    has_codes = isinstance(truth, StoredNumbers) and holds_integers(
        truth.file, of_scale=options.depth_scale
    )
    return StatedScale(options.depth_scale, str(files.gt) if has_codes else "")


def scale_of_truth(
    files: FrameFiles, options: ReadOptions, sparse: StoredDepth | None
) -> StatedScale:
    """Returns the scale that is stated of the ground truth, and of whose numbers it is stated.

    `--depth-scale` is of both files of a frame, but of the integers alone if the sparse depth holds
    integers. What a layout states is of integers only.

    Args:
        files: The files of the frame, with the scales that the data set states.
        options: Options with `--depth-scale`, which goes before.
        sparse: What the file of the sparse depth holds. None: there is none.
    """
    if options.depth_scale is None:
        return _scale_of_layout(files, files.gt_scale)
    has_codes = isinstance(sparse, StoredNumbers) and holds_integers(sparse.file)
    return StatedScale(options.depth_scale, str(files.sparse) if has_codes else "")


def _scale_of_layout(files: FrameFiles, scale: float | None) -> StatedScale:
    """The scale that a data set states: a list of this very file, a layout of integers only.

    Args:
        files: The files of the frame.
        scale: Numbers per metre that the data set states of one of them. None: it states none.
    """
    return StatedScale(scale, "" if files.scales_stated else OF_DATA_SET)
