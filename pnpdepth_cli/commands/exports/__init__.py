"""Exports of refined depth for reconstruction programs: one file each, in `choices.EXPORTS`.

A new export is one new file in this folder, or an entry point of the group `pnpdepth.exports`, that
holds an `Export` called `EXPORT`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.commands.refinement.frame_camera import FrameCamera
from pnpdepth_cli.commands.results import ResultFrame
from pnpdepth_cli.io.atomic import atomic_path, make_folder


@dataclass(frozen=True, kw_only=True)
class ExportFrame:
    """A refined frame."""

    result: ResultFrame
    image: Path
    image_name: str
    """Its path below the folder of the images, as COLMAP names it, with slashes."""
    size: tuple[int, int]
    """(H, W)."""
    camera: FrameCamera
    """Its pose is in the unit of the result."""
    unit_scale: float
    """Units of the depth per unit of the COLMAP model; 1 without a model."""
    farthest: float
    """Depth of the farthest sparse point."""

    @property
    def stem(self) -> str:
        """The image name without its suffix."""
        return PurePosixPath(self.image_name).with_suffix("").as_posix()

    def valid_depth(self) -> NDArray[np.float32]:
        """Returns the (H, W) depth, 0 where it is unknown or not valid."""
        depth, valid = self.result.read()
        return np.where(valid, depth, np.float32(0))


@dataclass(frozen=True, kw_only=True)
class Export:
    """How depth is written for a program."""

    needs_pose: bool
    files: Callable[[Path, Sequence[ExportFrame]], list[Path]]
    """The files that `write` writes into a folder."""
    write: Callable[[Path, Sequence[ExportFrame]], list[str]]
    """Writes them and returns notes. Raises PnpDepthError."""


@contextmanager
def new_file(path: Path) -> Iterator[Path]:
    """Yields a temporary file that becomes the path, whose folder is created."""
    make_folder(path.parent)
    with atomic_path(path) as temporary:
        yield temporary


def distortion_note(frames: Sequence[ExportFrame], taker: str) -> list[str]:
    """Returns a warning if images are distorted, for a program that takes undistorted ones."""
    count = sum(frame.camera.camera.has_lens for frame in frames)
    if not count:
        return []
    return [
        f"warning: {count:,} of {len(frames):,} images have lens distortion, and so has their"
        f" depth; {taker} takes undistorted ones: run COLMAP's image_undistorter and refine its"
        " output"
    ]
