"""Options of a bag. Imports neither numpy nor torch."""

from __future__ import annotations

from dataclasses import dataclass

from pnpdepth_cli.errors import UsageError
from pnpdepth_cli.pipeline.options import option


@dataclass(frozen=True, kw_only=True)
class BagOptions:
    """Which messages of a ROS bag make a frame."""

    image_topic: str | None = option(
        None, "Topic of the images of a bag.  [default: the only one]", metavar="TOPIC"
    )
    points_topic: str | None = option(
        None, "Topic of the PointCloud2 of a bag.  [default: the only one]", metavar="TOPIC"
    )
    tolerance: float = option(
        0.05,
        "Largest time between an image of a bag and its scan.",
        metavar="SECONDS",
        show_default=True,
    )

    poses_topic: str | None = option(
        None,
        "Topic of the camera's poses in a bag: odometry, poses or transforms.  [default: the only"
        " one]",
        metavar="TOPIC",
    )

    def __post_init__(self) -> None:
        if not self.tolerance >= 0:
            raise UsageError(f"--tolerance {self.tolerance:g} is no time; give 0 s or more")
