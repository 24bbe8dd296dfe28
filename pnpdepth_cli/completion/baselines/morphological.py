"""Morphological fill (IP-Basic)."""

from __future__ import annotations

from pnpdepth_cli.completion.baseline import Baseline
from pnpdepth_cli.completion.interpolation import morphological

baseline = Baseline(title="morphological fill (IP-Basic)", of_points=morphological)
