"""Inverse distance weighting."""

from __future__ import annotations

from pnpdepth_cli.completion.baseline import Baseline
from pnpdepth_cli.completion.interpolation import inverse_distance

baseline = Baseline(title="inverse distance weighting", of_points=inverse_distance, pointwise=True)
