"""A worker of a cluster as the driver knows it."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import Any

from pnpdepth_cli.pipeline.cluster.pieces import Piece
from pnpdepth_cli.pipeline.cluster.worker import Done, Facts


@dataclass(kw_only=True)
class Member:
    """A worker as the driver knows it."""

    number: int
    """Counts the workers that were started."""
    actor: Any
    """Its handle."""
    calls: deque[tuple[Any, Piece | None]] = field(default_factory=deque)
    """References in their order, with the piece that each does."""
    facts: Facts | None = None
    """Of its node; None before it has started."""
    ready: bool = False
    """Whether it has opened the job."""
    streams: bool = False
    """Whether it may have items that no call finishes."""
    unfinished: list[Any] = field(default_factory=list)
    """Items of calls that have ended, without a result yet, in their order."""
    done: Done | None = None
    """Of the call before."""
    items: int = 0
    """All it has done."""
    finished: int = 0
    """Those of this job."""
    seconds: float = 0.0
    """In calls of this job."""
