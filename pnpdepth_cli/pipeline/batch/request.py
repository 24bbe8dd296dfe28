"""What the user asks of a batch. Imports neither numpy nor torch."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from pnpdepth_cli.choices import FRAME_PROTOCOLS, LAYOUTS
from pnpdepth_cli.errors import UsageError
from pnpdepth_cli.pipeline.cluster.options import ClusterOptions
from pnpdepth_cli.pipeline.refinement.request import RefineRequest
from pnpdepth_cli.settings import option


def parse_shard(text: str) -> tuple[int, int]:
    """Returns (I, N) of `I/N`. Raises UsageError for any other text."""
    number, slash, of = text.partition("/")
    if not (slash and number.isdecimal() and of.isdecimal()):
        raise UsageError(f"shard {text!r} is not of the form I/N, such as 1/4")
    return int(number), int(of)


@dataclass(frozen=True, kw_only=True)
class FrameSelection:
    """Which frames of a data set are taken, and how each is refined."""

    source: Path
    """A folder or a list of frames."""
    output: Path
    """The folder for the results."""
    refine: RefineRequest
    """How a frame is refined; its files, output and protocol are set for each frame."""
    layout: str | None = option(
        None, "Layout of the folder.  [default: recognised]", choices=LAYOUTS
    )
    protocol: str | None = option(
        None,
        "Crop and depth range of the frames.  [default: the layout's own]",
        choices=FRAME_PROTOCOLS,
    )
    limit: int | None = option(None, "Only the first N frames.", metavar="N")


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


@dataclass(frozen=True, kw_only=True)
class BatchRequest(FrameSelection):
    """Which frames to refine, and how."""

    workers: int = option(
        2,
        "Number of threads that read, and of threads that write.",
        metavar="N",
        show_default=True,
    )
    html: Path | None = option(
        None,
        "Write an HTML report: every frame before and after, the worst first.",
        metavar="FOLDER",
    )
    html_3d: bool = option(
        False,
        "With --html: also show every frame as a point cloud, before, after and ground truth; adds"
        " up to 2.5 MB a frame.",
    )
    batch_size: int = option(
        1,
        "Frames of one size that go through a fixed network together; more than 1 changes the last"
        " bits of the results.",
        metavar="N",
        show_default=True,
    )
    shard: tuple[int, int] | None = option(
        None, "Every N-th frame, starting at the I-th.", metavar="I/N", parse=parse_shard
    )
    sequence: SequenceOptions = field(default_factory=SequenceOptions)
    """What a frame takes over from its neighbours."""
    profile: bool = option(False, "Print the time spent in each stage.")
    cluster: ClusterOptions = field(default_factory=ClusterOptions)
    """The Ray workers, if any."""

    def __post_init__(self) -> None:
        from pnpdepth_cli.io.dataset.protocols import find_protocol

        if self.html_3d and self.html is None:
            raise UsageError("--html-3d adds to the report; name its folder with --html")
        if self.workers < 1:
            raise UsageError(f"workers {self.workers}: at least one thread has to read")
        if self.batch_size < 1:
            raise UsageError(f"batch size {self.batch_size}: give 1 or more frames")
        if self.limit is not None and self.limit < 1:
            raise UsageError(f"limit {self.limit}: give the number of frames to do, 1 or more")
        if self.shard is not None and not 1 <= self.shard[0] <= self.shard[1]:
            number, of = self.shard
            raise UsageError(f"shard {number}/{of}: give I/N with I from 1 to N, such as 1/4")
        if self.protocol is not None:
            find_protocol(self.protocol)
