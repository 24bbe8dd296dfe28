"""How the files of a frame are read. Imports neither numpy nor torch."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from pathlib import Path

from pnpdepth_cli import choices
from pnpdepth_cli.dataset.frame_files import SCAN_ONLY_SUFFIXES, FrameFiles
from pnpdepth_cli.errors import UsageError
from pnpdepth_cli.file_record import SamplePattern
from pnpdepth_cli.protocols import ForegroundFilter
from pnpdepth_cli.settings import option


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

    def describes(self, sparse: Path) -> bool:
        """Returns whether the sparse depth is a scan: by its suffix, or x y z with a calibration.

        A calibration of other sparse depth is that of the camera.

        Raises:
            InputError: A list of points cannot be read.
            UsageError: It is not, and an option is given that only a scan has.
        """
        suffix = sparse.suffix.lower()
        if suffix in SCAN_ONLY_SUFFIXES:
            return True
        if self.calib is not None and suffix in (".npy", ".csv", ".txt"):
            from pnpdepth_cli.io.depth import holds_scan

            if holds_scan(sparse):
                return True
        if self.extrinsics is not None or (self.calib is None and self.camera is not None):
            raise UsageError(
                f"{sparse} is no scan, so --extrinsics and --camera do not apply; a scan needs"
                " --calib"
            )
        return False

    def over(self, files: FrameFiles) -> ScanOptions:
        """Returns these options, with the calibration and camera that the data set names.

        The user's own go before.
        """
        if (calib := self.calib or files.calib) is None:
            return self
        camera = files.camera if self.camera is None else self.camera
        return replace(self, calib=calib, camera=camera)


@dataclass(frozen=True, kw_only=True)
class ReadOptions:
    """What the user says of the files of a frame, over what the data set says."""

    depth_scale: float | None = option(
        None,
        "Integer depth files hold metres × S.  [default: from the file, else 256]",
        metavar="S",
    )
    unit_scale: float | None = option(
        None,
        "Metres per unit of a COLMAP model.  [default: depth is in model units]",
        metavar="M",
    )
    sparse_range: bool = option(
        False,
        "Sparse depth is the distance from the camera, not depth z; needs --calib.",
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
    sample_seed: int | None = None
    """Random seed of `sample`. None: that of the method."""

    def __post_init__(self) -> None:
        if self.unit_scale is not None and not 0 < self.unit_scale < math.inf:
            raise UsageError(
                f"--unit-scale must be above 0 metres per unit, got {self.unit_scale:g}"
            )
