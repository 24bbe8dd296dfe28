"""Options of a LiDAR scan, a COLMAP model and a bag. Imports neither numpy nor torch."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

from pnpdepth_cli.errors import UsageError
from pnpdepth_cli.settings import option, options_of

METRES, MODEL_UNITS = "m", "model units"


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
        "Pose of the scanner in the camera's frame: matrix, quaternion or tf.",
        within="--scan",
        metavar="FILE",
    )
    inverse_extrinsics: bool = option(
        False, "The pose maps the camera to the scanner.", within="--scan"
    )
    camera: int | None = option(
        None, "Camera number of KITTI (0 to 3) or Kalibr.  [default: 2; 0]", metavar="N"
    )
    euclidean: bool = option(
        False, "Depth is the distance from the camera, not z.", within="--scan"
    )
    keep_occluded: bool = option(
        False, "Keep LiDAR points that are occluded from the camera.", within="--scan"
    )
    min_range: float = option(
        0.0, "Drop points nearer than M metres.", within="--scan", metavar="M"
    )
    max_range: float | None = option(
        None, "Drop points farther than M metres.", within="--scan", metavar="M"
    )
    point_fields: int | None = option(
        None,
        "Float32 numbers of a point in a .bin: KITTI 4, nuScenes 5.  [default: recognised]",
        within="--scan",
        metavar="N",
        least=3,
        most=64,
    )

    def describes(self, sparse: Path) -> bool:
        """Returns whether the sparse depth is a scan: by its suffix, or a .npy with a calibration.

        A calibration of other sparse depth is that of the camera.

        Raises:
            UsageError: It is not, and an option is given that only a scan has.
        """
        from pnpdepth_cli.io.dataset import SCAN_ONLY_SUFFIXES

        suffix = sparse.suffix.lower()
        if suffix in SCAN_ONLY_SUFFIXES or (suffix == ".npy" and self.calib is not None):
            return True
        camera = self.camera if self.calib is None else None
        if replace(self, calib=None, camera=camera, keep_occluded=False) != ScanOptions():
            for_maps = ("calib", "keep_occluded")
            flags = [each.flag for each in options_of(ScanOptions) if each.name not in for_maps]
            raise UsageError(
                f"{sparse} is no scan, so {', '.join(flags[:-1])} and {flags[-1]} do not apply; a"
                " scan needs --calib"
            )
        return False


@dataclass(frozen=True, kw_only=True)
class ColmapOptions:
    """Which points of a COLMAP model are used, and their unit."""

    unit_scale: float | None = option(
        None,
        "Metres per unit of a COLMAP model.  [default: depth is in model units]",
        within="--colmap",
        metavar="M",
    )
    min_track: int = option(
        3,
        "Drop points of a COLMAP model that fewer images observe.",
        within="--colmap",
        metavar="N",
        show_default=True,
    )
    max_reprojection: float = option(
        2.0,
        "Drop points of a COLMAP model with a larger mean reprojection error.",
        within="--colmap",
        metavar="PIXELS",
        show_default=True,
    )

    def __post_init__(self) -> None:
        if self.unit_scale is not None and not 0 < self.unit_scale < math.inf:
            raise UsageError(f"unit-scale must be above 0 metres per unit, got {self.unit_scale:g}")
        if self.min_track < 1:
            raise UsageError(f"min-track must be >= 1, got {self.min_track}")
        if not self.max_reprojection > 0:
            raise UsageError(f"max-reprojection must be above 0, got {self.max_reprojection:g}")


@dataclass(frozen=True, kw_only=True)
class BagOptions:
    """Which messages of a ROS bag make a frame."""

    topics: str | None = option(
        None,
        "Topics of a bag, separated by commas: of images, points (PointCloud2), and poses."
        "  [default: the only ones]",
        metavar="TOPIC,...",
    )
    tolerance: float = option(
        0.05,
        "Largest time between an image of a bag and its scan.",
        metavar="SECONDS",
        show_default=True,
    )

    def __post_init__(self) -> None:
        if not self.tolerance >= 0:
            raise UsageError(f"--tolerance must be >= 0, got {self.tolerance:g}")

    @property
    def wanted(self) -> list[str]:
        """The names of the topics."""
        return [name for name in (self.topics or "").split(",") if name]
