"""What all frames of one batch share while they are refined."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from pnpdepth_cli.pipeline.batch.profile import BatchProfile
from pnpdepth_cli.pipeline.batch.state import FrameRecorder


@dataclass(frozen=True, kw_only=True)
class BatchRun:
    """How frames are refined, and where their progress goes."""

    state: FrameRecorder
    """Records what is done."""
    profile: BatchProfile
    """Adds up where the time goes."""
    say: Callable[[str], None]
    """Receives notes and warnings."""
    stopped: Callable[[], bool]
    """True if no further frame is to be begun."""
    workers: int
    """Threads that read, and as many that write."""
    batch_size: int | None
    """Frames that go through the network together; None for as many as alter no result."""
