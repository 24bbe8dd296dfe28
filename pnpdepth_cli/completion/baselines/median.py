"""The prediction times the median of ratios."""

from __future__ import annotations

from pnpdepth_cli.completion.baseline import alignment_baseline

baseline = alignment_baseline("median of ratios", kind="median", space="depth")
