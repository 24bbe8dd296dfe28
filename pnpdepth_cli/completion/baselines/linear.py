"""Linear interpolation between the points."""

from __future__ import annotations

from pnpdepth_cli.completion.baseline import Baseline
from pnpdepth_cli.completion.interpolation import linear

baseline = Baseline(title="linear between points (Delaunay)", of_points=linear, pointwise=True)
