"""Options of a COLMAP model. Imports neither numpy nor torch."""

from __future__ import annotations

import math
from dataclasses import dataclass

from pnpdepth_cli.errors import UsageError
from pnpdepth_cli.pipeline.options import option

METRES, MODEL_UNITS = "m", "model units"


@dataclass(frozen=True, kw_only=True)
class ColmapOptions:
    """Which points of a COLMAP model are used, and their unit."""

    unit_scale: float | None = option(
        None,
        "Metres per unit of a COLMAP model.  [default: depth is in model units]",
        metavar="M",
    )
    min_track: int = option(
        3,
        "Drop points of a COLMAP model that fewer images observe.",
        metavar="N",
        least=1,
        show_default=True,
    )
    max_reprojection: float = option(
        2.0,
        "Drop points of a COLMAP model with a larger mean reprojection error.",
        metavar="PIXELS",
        show_default=True,
    )

    def __post_init__(self) -> None:
        if self.unit_scale is not None and not 0 < self.unit_scale < math.inf:
            raise UsageError(f"--unit-scale {self.unit_scale:g} is no length; give metres per unit")
        if self.min_track < 1 or not self.max_reprojection > 0:
            raise UsageError("--min-track must be 1 or more, and --max-reprojection above 0")
