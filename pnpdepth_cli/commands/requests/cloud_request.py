"""What the user asks of `pnpdepth cloud`. Imports neither numpy nor torch."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

from pnpdepth_cli.errors import OutputError, UsageError
from pnpdepth_cli.settings import option


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
        """Raises UsageError or OutputError for options that cannot be used."""
        if self.output.suffix.lower() != ".ply":
            raise OutputError(f"{self.output}: a cloud is written as PLY; name it NAME.ply")
        if self.pose_kind is not None and self.poses is None:
            raise UsageError("--pose-kind is for --poses")
        if self.image is not None and self.depth.is_dir():
            raise UsageError("--image is for one depth file; records name the images of a folder")
        if self.voxel is not None and not 0 < self.voxel < math.inf:
            raise UsageError(f"--voxel must be a length above 0, got {self.voxel:g}")
