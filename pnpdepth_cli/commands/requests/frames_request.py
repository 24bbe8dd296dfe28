"""What the user asks of `pnpdepth frames`. Imports neither numpy nor torch."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from pnpdepth_cli.errors import UsageError
from pnpdepth_cli.settings import option


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
        """Raises UsageError for frame numbers or a time that cannot be."""
        if self.between is not None and not 0 <= self.between[0] <= self.between[1]:
            first, last = self.between
            raise UsageError(f"--between {first} {last} has no frame; give FIRST LAST, from 0")
        if not self.tolerance >= 0:
            raise UsageError(f"--tolerance must be >= 0, got {self.tolerance:g}")
