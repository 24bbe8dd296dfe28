"""One frame of a data set: where its parts are, and what is needed to read them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

from pnpdepth_cli.errors import InputError
from pnpdepth_cli.io.dataset.protocols import WHOLE, Protocol

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".exr")
SCAN_ONLY_SUFFIXES = (".bin", ".pcd", ".ply")


@dataclass(frozen=True, kw_only=True)
class Hdf5Array:
    """An array in an HDF5 or MATLAB 7.3 file; index picks one of its first axis, if any.

    axes: the order that makes the rest (H, W) or (H, W, 3).
    """

    path: Path
    name: str
    axes: tuple[int, ...]
    index: int | None = None

    def __str__(self) -> str:
        return f"{self.path}[{self.name}{'' if self.index is None else f', {self.index}'}]"


Source = Path | Hdf5Array

Pose = tuple[tuple[float, ...], ...]
"""(3, 4): the rotation and, in the last column, the translation in metres."""


@dataclass(frozen=True, kw_only=True)
class Frame:
    """Parts that a frame does not have are None.

    name: unique in its data set, and fit for the name of a file, in a folder of its own where it
    contains a slash. sparse: a depth file, or a scan with calib; None where the protocol samples
    the truth. *_scale: codes per metre of integer files.
    calib, camera: as `read_calibration` takes them. protocol: what is cut out before anything else.
    group: the sequence it belongs to; None leaves it to its name.
    pose: x_world = pose · (x, 1) for points of KITTI's camera 0, whichever camera took the image.
    """

    name: str
    image: Source | None = None
    sparse: Path | None = None
    gt: Source | None = None
    calib: Path | None = None
    camera: int | None = None
    sparse_scale: float | None = None
    gt_scale: float | None = None
    protocol: Protocol = WHOLE
    pose: Pose | None = None
    group: str | None = None


@dataclass(frozen=True, kw_only=True)
class Unmatched:
    """A file or folder that is no part of a frame, and why."""

    path: Path
    why: str

    def __str__(self) -> str:
        return f"{self.path} {self.why}"


@dataclass(frozen=True, kw_only=True)
class Listing:
    """frames: in a fixed order. broken: why there are not more. spare: what lies there as well."""

    frames: list[Frame]
    broken: tuple[Unmatched, ...] = ()
    spare: tuple[Unmatched, ...] = ()


def by_stem(folder: Path, suffixes: Iterable[str]) -> dict[str, Path]:
    """The files of a folder with one of these suffixes, by their stem and in its order.

    InputError if two have the same stem.
    """
    wanted = set(suffixes)
    files: dict[str, Path] = {}
    for path in sorted(folder.iterdir() if folder.is_dir() else ()):
        if path.suffix.lower() in wanted and path.is_file():
            if path.stem in files:
                raise InputError(f"{path} and {files[path.stem].name} are one frame; keep one")
            files[path.stem] = path
    return files


def without_partner(
    files: Mapping[str, Path], others: Mapping[str, Path], folder: Path
) -> tuple[Unmatched, ...]:
    """The files of whose stem the folder, which holds the others, has none."""
    return tuple(
        Unmatched(path=path, why=f"has no partner {stem}.* in {folder}; add or remove one")
        for stem, path in files.items()
        if stem not in others
    )
