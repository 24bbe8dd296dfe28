"""What the user asks of clouds and bags, and which files that may replace.

Imports neither numpy nor torch.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from pnpdepth_cli.errors import OutputError, UsageError
from pnpdepth_cli.settings import option


def check_outputs(paths: Iterable[Path], inputs: Iterable[Path] = (), *, overwrite: bool) -> None:
    """Raises OutputError for a file that is an input, or that exists and may not be replaced."""
    # `Path.resolve` raises for a loop of symbolic links; whoever opens it says what is wrong.
    real_inputs = {os.path.realpath(path) for path in inputs}
    for path in paths:
        if os.path.realpath(path) in real_inputs:
            raise OutputError(f"{path} is one of the inputs; name another output")
        if path.exists() and not overwrite:
            raise OutputError(f"{path} exists; --overwrite replaces it, or name another output")


@dataclass(frozen=True, kw_only=True)
class CloudRequest:
    """What the user asks of a cloud."""

    depth: Path
    """A depth file, or a folder with files NAME_depth.SUFFIX, as `refine` and `batch` write."""
    output: Path
    """The PLY file to write."""
    image: Path | None = option(None, "Image with the colours.  [default: the record's]")
    calib: Path | None = option(
        None,
        "Calibration of the camera: a file with K, or a KITTI file or raw folder.  [default: the"
        " record's, else EXIF]",
        metavar="FILE|FOLDER",
    )
    poses: Path | None = option(
        None,
        "Camera poses of a folder's files: TUM rows are joined by time, KITTI rows by order,"
        " transforms.json by name.  [default: the records']",
    )
    pose_kind: str | None = None
    """What `poses` are, as `poses_of_frames` takes it."""
    depth_scale: float | None = None
    """Integer depth files hold metres × this."""
    max_depth: float = option(math.inf, "Drop farther pixels.", metavar="M")
    max_sigma: float | None = option(
        None,
        "Drop pixels whose standard deviation is above this fraction of their depth.",
        metavar="F",
    )
    min_views: int = option(
        1, "Keep pixels on which N views agree; their depth is the mean.", metavar="N", least=1
    )
    voxel: float | None = option(None, "Merge the points in cubes of this side.", metavar="M")
    overwrite: bool = False

    def __post_init__(self) -> None:
        if self.output.suffix.lower() != ".ply":
            raise OutputError(f"{self.output}: a cloud is written as PLY; name it NAME.ply")
        if self.pose_kind is not None and self.poses is None:
            raise UsageError("--pose-kind is for --poses")
        if self.image is not None and self.depth.is_dir():
            raise UsageError("--image is for one depth file; records name the images of a folder")
        if self.voxel is not None and not 0 < self.voxel < math.inf:
            raise UsageError(f"--voxel must be a length above 0, got {self.voxel:g}")


@dataclass(frozen=True, kw_only=True)
class FramesRequest:
    """Which bag to write as files, and where."""

    bag: Path
    output: Path
    """The folder for rgb/, sparse/, calib.txt, poses.txt and frames.json."""
    topics: tuple[str, ...] = ()
    """Topics of images, of points (PointCloud2) and of poses; else the only one of its kind."""
    tolerance: float = option(
        0.05, "Largest time between an image and its scan.", metavar="SECONDS"
    )
    clock_offset: float | None = option(
        None,
        "Added to the times of the points.  [default: 0; by the times of the log if above 1 s]",
        metavar="SECONDS",
    )
    between: tuple[int, int] | None = option(
        None, "Only the frames of these numbers, from 0.", metavar="FIRST LAST"
    )
    every: int = option(1, "Only every N-th of these.", metavar="N", least=1)
    depth_scale: float | None = None
    """Numbers per metre of the points. None: what the bag says, else millimetres of integers."""
    overwrite: bool = False

    def __post_init__(self) -> None:
        if self.between is not None and not 0 <= self.between[0] <= self.between[1]:
            raise UsageError("--between {} {} has no frame; give FIRST LAST".format(*self.between))
        if not self.tolerance >= 0:
            raise UsageError(f"--tolerance must be >= 0, got {self.tolerance:g}")
