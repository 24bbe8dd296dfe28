"""Exports of results for reconstruction programs, one file each, in `choices.EXPORTS`.

A new export is one new file in this folder, or an entry point of the group `pnpdepth.exports`, that
holds an `Export` called `EXPORT`.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.camera import Camera
from pnpdepth_cli.commands.shared.results import ResultFrame
from pnpdepth_cli.dataset.arrays import image_of_size, read_image
from pnpdepth_cli.dataset.frame_files import ImageSource
from pnpdepth_cli.dataset.frame_record import Pose
from pnpdepth_cli.errors import InputError
from pnpdepth_cli.io.atomic import atomic_path
from pnpdepth_cli.sensors.point_cloud import PointCloud, cloud_from_depth

_START_POINTS = 200_000
"""Number of points of all frames together that a splatting program begins with."""


@dataclass(frozen=True, kw_only=True)
class ExportFrame:
    """A refined frame."""

    result: ResultFrame
    """The depth file, and what lies beside it."""
    image: ImageSource
    """The image that was refined: a file, or a frame of a video."""
    image_path: Path
    """The image in the output folder, or where it is copied to: programs read it there."""
    image_name: str
    """Path of the image below the folder of images, as COLMAP names it, with slashes."""
    size: tuple[int, int]
    """(H, W) of the depth and the image."""
    camera: Camera
    """The camera in pixels of the image."""
    pose: Pose | None
    """(3, 4) from the camera's coordinates to the world's, in the unit of the result. None:
    unknown."""
    unit_scale: float
    """Units of the depth per unit of the COLMAP model; 1 without a model."""
    unknown: str = "keep"
    """What a program without masks gets of pixels that are not valid: one of `choices.UNKNOWN`."""

    @property
    def stem(self) -> str:
        """The image name without its suffix."""
        return PurePosixPath(self.image_name).with_suffix("").as_posix()

    def valid_depth(self) -> NDArray[np.float32]:
        """Returns the (H, W) depth in the result's unit, 0 where it is unknown or not valid."""
        depth, valid = self.result.read()
        return np.where(valid, depth, np.float32(0))

    def copy_image(self) -> None:
        """Writes the image to its path."""
        from PIL import Image

        with atomic_path(self.image_path) as temporary:
            if isinstance(self.image, Path):
                shutil.copyfile(self.image, temporary)
            else:
                pixels = np.rint(255 * read_image(self.image)).astype(np.uint8)
                Image.fromarray(pixels).save(temporary, "PNG")

    def known_pose(self) -> Pose:
        """Returns the pose. Raises InputError if it is unknown."""
        if self.pose is None:
            raise InputError(
                f"{self.result.depth} lacks a pose in its record; `batch --poses` gives it"
            )
        return self.pose

    def start_points(self, frames: int) -> PointCloud:
        """Returns every n-th point of the depth: about the frame's part of `_START_POINTS`.

        They are coloured, and in the world's coordinates, in the unit of the result.

        Args:
            frames: Number of frames, each of which gives an equal part of `_START_POINTS`.

        Raises:
            InputError: The pose is unknown.
        """
        rgb = image_of_size(self.image, self.size)
        clouds = list(cloud_from_depth(self.valid_depth(), self.camera, rgb))
        # Every n-th point of the frame. The clouds are joined field by field: all xyz, all normals,
        # all colours.
        step = max(1, sum(len(cloud.xyz) for cloud in clouds) * frames // _START_POINTS)
        fields = [np.concatenate(parts)[::step] for parts in zip(*clouds, strict=True)]
        return PointCloud(*fields).transform(self.known_pose())


@dataclass(frozen=True, kw_only=True)
class Export:
    """How depth is written for a program."""

    needs_pose: bool
    """Whether every frame must have a pose."""
    files: Callable[[Path, Sequence[ExportFrame]], list[Path]]
    """Function of the output folder and the frames: returns the files that `write` will write."""
    write: Callable[[Path, Sequence[ExportFrame], Callable[[], None]], list[str]]
    """Function of the output folder, the frames and a callback: writes the files, calls back after
    each frame, and returns lines for a person. The folders of the files are there. Raises
    PnpDepthError."""
    in_model_units: bool = True
    """Whether the files are in units of the COLMAP model, if there is one; else in those of the
    results."""
    copies_images: bool = False
    """Whether images that do not lie in the folder are copied there."""


def distortion_note(frames: Sequence[ExportFrame], taker: str) -> list[str]:
    """Returns a warning if images are distorted, for a program that takes undistorted ones.

    Args:
        frames: The frames.
        taker: Name of the program.
    """
    count = sum(frame.camera.has_lens for frame in frames)
    if not count:
        return []
    return [
        f"warning: {count:,} of {len(frames):,} images have lens distortion, and so has their"
        f" depth; {taker} takes undistorted ones: run COLMAP's image_undistorter and refine its"
        " output"
    ]
