"""Options of a LiDAR scan. Imports neither numpy nor torch."""

from __future__ import annotations

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
        metavar="FILE",
    )
    camera: int | None = option(
        None, "Camera number of KITTI (0 to 3) or Kalibr.  [default: 2; 0]", metavar="N"
    )
    keep_occluded: bool = False
    """Whether points that are occluded from the camera stay."""

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
