"""From a scan to sparse depth in the picture: what the camera sees of what the scanner saw."""

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
    """How a scan becomes sparse depth.

    euclidean: depth is the distance from the camera's centre instead of z, along its axis.
    min_range, max_range: metres from the scanner; what lies outside is dropped.
    occlusion: None keeps the points that the camera sees something nearer in front of.
    """

    euclidean: bool = False
    min_range: float = 0.0
    max_range: float = np.inf
    occlusion: OcclusionFilter | None = field(default_factory=OcclusionFilter)

    def __post_init__(self) -> None:
        if not 0 <= self.min_range < self.max_range:
            raise UsageError(
                f"range {self.min_range:g} to {self.max_range:g} m is empty; give"
                " 0 ≤ minimum < maximum"
            )


@dataclass(frozen=True, kw_only=True)
class ProjectedScan(Points):
    """The points of a scan that the camera sees, in the scan's order; index (N,): their rows."""

    index: NDArray[np.intp]


def project_velodyne(
    points: NDArray[np.floating],
    camera: Camera,
    size: tuple[int, int],
    settings: ProjectionSettings | None = None,
) -> ProjectedScan:
    """The scan as sparse depth in the picture of `size` (H, W).

    points: (N, 3) or more columns, x y z in metres in the scanner's frame. Raises NoPointsError
    when the picture shows none of them.
    """
    settings = settings or ProjectionSettings()
    place = np.asarray(points)[:, :3]
    drops = DropCounter(len(place))
    distance = np.sqrt(np.einsum("ij,ij->i", place, place))
    in_range = (distance >= settings.min_range) & (distance <= settings.max_range)
    seen = camera.from_scanner(place[drops.keep(in_range, "out of range")])
    seen = seen[drops.keep(seen[:, 2] > 0, "behind the camera")]
    xy = camera.pixels_of(seen)
    inside = drops.keep(in_frame(xy, size), "outside the picture")
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
            f"none of the scan's {len(place):,} points lies in the picture ({drops}); check that"
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
