"""What the user asks of a batch, and who hears of it. Imports neither numpy nor torch."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

from pnpdepth_cli.choices import LAYOUTS, POSE_KINDS, PROTOCOLS
from pnpdepth_cli.commands.requests.refine_request import RefineRequest, parse_sample
from pnpdepth_cli.dataset.frame_files import ReadOptions
from pnpdepth_cli.errors import UsageError
from pnpdepth_cli.measures import MEASURES, choose_measures, parse_keys
from pnpdepth_cli.protocols import find_protocol
from pnpdepth_cli.settings import option

if TYPE_CHECKING:
    from pnpdepth_cli.dataset.frame_record import FrameRecord

LOCAL = "local"
"""The address of a Ray cluster of this machine's devices, which ends with the command."""
_ADDRESS = re.compile(r"(ray://)?[^/]+:\d+")
"""HOST:PORT or ray://HOST:PORT."""


def parse_shard(text: str) -> tuple[int, int]:
    """Returns (I, N) of `I/N`. Raises UsageError for any other text."""
    index, slash, count = text.partition("/")
    if slash and index.isdecimal() and count.isdecimal() and 1 <= int(index) <= int(count):
        return int(index), int(count)
    raise UsageError(f"--shard must be I/N with I from 1 to N, such as 1/4, got {text}")


def parse_address(text: str) -> str:
    """Returns the address of a cluster. Raises UsageError for a text that is none."""
    if text in (LOCAL, "auto") or _ADDRESS.fullmatch(text):
        return text
    raise UsageError(
        f"{text!r} is no address of a Ray cluster; give --ray=auto, --ray=HOST:PORT, or --ray as"
        " the last option for this machine"
    )


@dataclass
class Listener:
    """Hears of the progress of a batch, and may stop it; its counts are numbers of frames."""

    say: Callable[[str], None]  # receives a note or a warning, one line
    show: Callable[[int, int], None]  # receives how many are done or have failed, of how many
    stopped: Callable[[], bool]  # asked before each frame; True ends the batch
    done: int = 0  # frames that are done or have failed
    to_do: int = 0  # frames that the batch refines, those that are done among them

    def begin(self, to_do: int) -> None:
        """Starts counting; `to_do` frames follow."""
        self.to_do = to_do
        self.show(0, to_do)

    def frame(self, record: FrameRecord) -> None:
        """Counts a frame, and says why it diverged or failed if it did."""
        if record.status != "done":
            self.say(f"{record.status}: {record.name}: {record.message}")
        self.done += 1
        self.show(self.done, self.to_do)


@dataclass(frozen=True, kw_only=True)
class BatchRequest:
    """Which frames to refine, and how."""

    source: Path
    """A folder or a list of frames."""
    output: Path
    refine: RefineRequest
    """How a frame is refined; its files, output and protocol are set for each frame."""
    depth: Path | None = option(
        None,
        "Folder of depth maps that a network predicted, named as the frames or their images; they"
        " take the place of its output.",
        metavar="FOLDER",
    )
    layout: str | None = option(
        None, "Layout of the folder.  [default: recognised]", choices=LAYOUTS
    )
    protocol: str | None = option(
        None,
        "Crop and points of the frames, by which `eval` scores too.  [default: the layout's own]",
        choices=PROTOCOLS,
    )
    names: str | None = option(
        None, "Only frames whose names match, such as 'drive_1/*'.", metavar="GLOB", flag="--frames"
    )
    every: int = option(1, "Only every N-th of these.", metavar="N", least=1)
    limit: int | None = option(None, "Only the first N of these.", metavar="N", least=1)
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
    columns: tuple[str, ...] | None = option(
        None,
        "Measures of the tables, in this order, such as rmse,mae,delta1.",
        metavar="KEY,…",
        type=parse_keys,
    )
    shard: tuple[int, int] | None = option(
        None, "Every N-th frame, starting at the I-th.", metavar="I/N", type=parse_shard
    )
    adapt: bool = option(
        False,
        "First let the weights learn from points that are left out of each sequence (8 frames or"
        " more); its frames are refined with them if they are better. The network must take"
        " points.",
    )
    accumulate: int = option(
        0,
        "Add the points of the N frames before and after, moved by the camera's poses or, without"
        " poses, by its motion as estimated from the images.",
        metavar="N",
        least=0,
    )
    poses: Path | None = option(
        None,
        "Camera poses of the frames, for --accumulate and the records, from which `cloud` takes"
        " them: TUM rows are joined by time, KITTI rows by order, transforms.json by name."
        "  [default: the layout's or poses.txt]",
        metavar="FILE",
    )
    pose_kind: str | None = option(
        None,
        "Kind of the poses of --poses; OpenGL's axes are y up and z back."
        "  [default: opengl of transforms.json, else camera-to-world]",
        choices=POSE_KINDS,
    )
    ray: str | None = option(
        None,
        "Run on a Ray cluster: auto, HOST:PORT or ray://HOST:PORT. Without an address, on all"
        " cores of this machine, with --device cuda on all GPUs. Needs the extra ray.",
        metavar="[ADDRESS]",
        type=parse_address,
        is_flag=False,
        flag_value=LOCAL,
    )
    varied: Mapping[str, str] = field(default_factory=dict)
    """Options that a study varies, and their values here, as the user wrote them."""

    def __post_init__(self) -> None:
        """Raises UsageError for options that do not go together, or an unknown measure."""
        if self.adapt and self.shard is not None:
            raise UsageError("--adapt does not go with --shard; weights are learnt in one process")
        if self.html_3d and self.html is None:
            raise UsageError("--html-3d adds to the report; name its folder with --html")
        if self.pose_kind is not None and self.poses is None:
            raise UsageError("--pose-kind is for --poses")
        if self.ray is not None and self.refine.device not in ("cpu", "cuda"):
            raise UsageError("--ray computes on --device cpu, or on all GPUs with --device cuda")
        choose_measures(MEASURES, self.columns)  # raises for an unknown key

    @property
    def is_of_bag(self) -> bool:
        """Whether the source is a bag, whose frames are unpacked first."""
        from pnpdepth_cli.io.bags import is_bag  # imports numpy, which --help does without

        return is_bag(self.source)

    @property
    def reading(self) -> ReadOptions:
        """How the files of every frame are read: as the user says, and as the protocol says.

        Both may say which points are sampled from the ground truth; then the user's pattern counts.
        The filter of LiDAR points behind the foreground is the protocol's alone.
        """
        options = self.refine.reading
        if self.protocol is None:
            return options
        protocol = find_protocol(self.protocol)
        options = replace(options, foreground=protocol.foreground)
        if options.sample is None and protocol.sample is not None:
            sample = replace(parse_sample(protocol.sample), seed=protocol.seed)
            options = replace(options, sample=sample)
        return options
