"""Linear interpolation of log depth."""

from __future__ import annotations

from functools import partial

from pnpdepth_cli.completion.baseline import Baseline
from pnpdepth_cli.completion.interpolation import linear

baseline = Baseline(
    title="linear between points, in log depth",
    of_points=partial(linear, space="log"),
    pointwise=True,
)
