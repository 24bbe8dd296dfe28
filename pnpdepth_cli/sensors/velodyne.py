"""LiDAR scans projected into a camera's image, without the points that the camera cannot see."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.errors import NoPointsError, UsageError
from pnpdepth_cli.points import in_frame
from pnpdepth_cli.sensors.camera import Camera
from pnpdepth_cli.sensors.occlusion import OcclusionFilter, hidden_points
from pnpdepth_cli.sensors.sparse import DropCounter, Points, nearest_in_pixel


@dataclass(frozen=True, kw_only=True)
class ProjectionSettings:
    """How a scan becomes sparse depth."""

    euclidean: bool = False
    """Depth is the distance from the camera's centre instead of z, along its axis."""

    min_range: float = 0.0
    """Metres from the scanner; nearer points are dropped."""

    max_range: float = np.inf
    """Metres from the scanner; farther points are dropped."""

    occlusion: OcclusionFilter | None = field(default_factory=OcclusionFilter)
    """When a point counts as occluded; None keeps occluded points."""

    def __post_init__(self) -> None:
        if not 0 <= self.min_range < self.max_range:
            raise UsageError(
                f"range {self.min_range:g} to {self.max_range:g} m is empty; give"
                " 0 ≤ minimum < maximum"
            )


@dataclass(frozen=True, kw_only=True)
class ProjectedScan(Points):
    """The points of a scan that the camera sees, in the scan's order."""

    index: NDArray[np.intp]
    """(N,) row of each point in the scan."""


def project_velodyne(
    points: NDArray[np.floating],
    camera: Camera,
    size: tuple[int, int],
    settings: ProjectionSettings | None = None,
) -> ProjectedScan:
    """Returns the scan as sparse depth in an image.

    Args:
        points: (N, 3) or more columns, x y z in metres in the scanner's frame.
        camera: Intrinsics and the scanner's pose.
        size: (H, W) of the image.
        settings: Ranges and occlusion; None for the defaults.

    Raises:
        NoPointsError: No point is visible in the image.
    """
    settings = settings or ProjectionSettings()
    xyz = np.asarray(points)[:, :3]
    drops = DropCounter(len(xyz))
    distance = np.sqrt(np.einsum("ij,ij->i", xyz, xyz))
    in_range = (distance >= settings.min_range) & (distance <= settings.max_range)
    seen = camera.from_scanner(xyz[drops.keep(in_range, "out of range")])
    seen = seen[drops.keep(seen[:, 2] > 0, "behind the camera")]
    xy = camera.pixels_of(seen)
    inside = drops.keep(in_frame(xy, size), "outside the image")
    seen, xy = seen[inside], xy[inside]
    front = drops.keep(nearest_in_pixel(xy, seen[:, 2], size), "behind another in their pixel")
    seen, xy = seen[front], xy[front]
    if settings.occlusion is not None:
        hidden = hidden_points(
            xy,
            seen[:, 2],
            size,
            focal_px=float(camera.intrinsics[0, 0]),
            scanner=np.asarray(camera.intrinsics @ camera.translation),
            settings=settings.occlusion,
        )
        visible = drops.keep(~hidden, "hidden by foreground")
        seen, xy = seen[visible], xy[visible]
    if not len(xy):
        raise NoPointsError(
            f"none of the scan's {len(xyz):,} points lies in the image ({drops}); check that"
            " scan and calibration belong to this camera"
        )
    depth = np.linalg.norm(seen, axis=1) if settings.euclidean else seen[:, 2]
    return ProjectedScan(
        xy=xy.astype(np.float32),
        depth=depth.astype(np.float32),
        index=drops.index,
        size=size,
        dropped=drops.dropped,
    )
