"""Options of frames that are a sequence. Imports neither numpy nor torch."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from pnpdepth_cli.errors import UsageError
from pnpdepth_cli.pipeline.options import option


@dataclass(frozen=True, kw_only=True)
class SequenceOptions:
    """What a frame takes over from its neighbours."""

    accumulate: int = option(
        0,
        "Add the points of the N frames before and after, moved by the camera's poses or, without"
        " poses, by its motion as estimated from images or scans.",
        metavar="N",
    )
    poses: Path | None = option(
        None,
        "Camera poses of the frames in their order (KITTI or TUM rows).  [default: the layout's,"
        " else estimated]",
        metavar="FILE",
    )

    warm_start: int = option(
        0,
        "Refine windows of N frames in order, each frame from where the one before ended.",
        metavar="N",
    )

    def __post_init__(self) -> None:
        if self.accumulate < 0:
            raise UsageError(f"--accumulate {self.accumulate}: give a number of frames, 0 or more")
        if self.warm_start < 0 or self.warm_start == 1:
            raise UsageError(f"--warm-start {self.warm_start}: give a window of 2 frames or more")
        if self.poses is not None and not self.accumulate:
            raise UsageError("--poses is for --accumulate; give --accumulate 2, say")
