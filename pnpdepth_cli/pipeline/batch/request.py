"""What the user asks of a batch. Imports neither numpy nor torch."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from pnpdepth_cli.choices import FRAME_PROTOCOLS, LAYOUTS
from pnpdepth_cli.errors import UsageError
from pnpdepth_cli.pipeline.batch.sequence_options import SequenceOptions
from pnpdepth_cli.pipeline.cluster.options import ClusterOptions
from pnpdepth_cli.pipeline.options import option
from pnpdepth_cli.pipeline.refinement.request import RefineRequest


def parse_batch_size(text: str) -> int | None:
    """Returns the number of frames, None for `auto`. Raises UsageError for any other text."""
    if text != "auto" and not text.isdecimal():
        raise UsageError(f"batch size {text!r} is neither auto nor a number of frames such as 8")
    return None if text == "auto" else int(text)


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
    batch_size: int | None = option(
        None,
        "Number of frames per forward pass. auto: as many as save time without changing a bit of"
        " the results.  [default: auto]",
        metavar="auto|N",
        parse=parse_batch_size,
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
        if self.batch_size is not None and self.batch_size < 1:
            raise UsageError(f"batch size {self.batch_size}: give 1 or more frames, or auto")
        if self.limit is not None and self.limit < 1:
            raise UsageError(f"limit {self.limit}: give the number of frames to do, 1 or more")
        if self.shard is not None and not 1 <= self.shard[0] <= self.shard[1]:
            number, of = self.shard
            raise UsageError(f"shard {number}/{of}: give I/N with I from 1 to N, such as 1/4")
        if self.protocol is not None:
            find_protocol(self.protocol)
