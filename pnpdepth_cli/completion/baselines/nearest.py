"""Nearest point."""

from __future__ import annotations

from pnpdepth_cli.completion.baseline import Baseline
from pnpdepth_cli.completion.interpolation import nearest

baseline = Baseline(title="nearest point", of_points=nearest, pointwise=True)
