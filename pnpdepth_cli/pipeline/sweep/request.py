"""What the user asks of a sweep."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from pnpdepth_cli.errors import UsageError
from pnpdepth_cli.pipeline.batch.request import FrameSelection
from pnpdepth_cli.pipeline.cluster.options import ClusterOptions
from pnpdepth_cli.pipeline.sweep.axes import Study
from pnpdepth_cli.pipeline.sweep.points import Sampling


@dataclass(frozen=True, kw_only=True)
class SweepRequest(FrameSelection):
    """What to vary, over which frames."""

    studies: Sequence[Study]
    """As `studies_of` returns them."""
    sampling: Sampling | None = None
    """Where points come from unless that is varied; None for the frames' own, or else the ground
    truth."""
    seeds: int = 1
    """Draws of the points, with consecutive seeds."""
    plots: bool = True
    """True to write a plot of each study."""
    plot_format: str = "png"
    """One of PLOT_FORMATS."""
    cost: bool = False
    """True to report the time of the refinement beside its error."""
    resamples: int = 2000
    """Bootstrap samples behind the intervals."""
    cluster: ClusterOptions = field(default_factory=ClusterOptions)
    """The Ray workers, if any."""

    def __post_init__(self) -> None:
        if self.seeds < 1:
            raise UsageError(f"seeds {self.seeds}: the points have to be drawn once at least")
