"""A frame as it was read: what the method needs, and what its result is scored and kept with."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.file_record import FileRecord
from pnpdepth_cli.frames.frame import DepthMap, Frame
from pnpdepth_cli.points import SparsePoints


@dataclass(frozen=True, kw_only=True)
class ReadFrame(Frame):
    """A frame of files. No method reads what is declared here."""

    own_points: SparsePoints
    """All points of the frame's own files, also those held out, without those of neighbours."""
    held_out: SparsePoints
    """Points that nothing uses, to score at; none of them unless it was asked for."""
    gt: DepthMap | None = None
    """(H, W) metres, 0 = unknown. None without ground truth."""
    pose: NDArray[np.float64] | None = None
    """(3, 4) from the camera's coordinates to the world's, in `unit`. None: unknown."""
    depth_scale: float | None = None
    """Integers per metre of the file of the sparse depth. None if it holds metres."""
    sources: Mapping[str, FileRecord] = field(default_factory=dict)
    """What a record keeps of each file, by what it is of: "image", "sparse", "gt", …"""
    neighbours: tuple[FileRecord, ...] = ()
    """What a record keeps of neighbouring frames; `points` has the points of those that join."""
