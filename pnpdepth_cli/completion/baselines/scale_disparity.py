"""The predicted disparity times a scale."""

from __future__ import annotations

from pnpdepth_cli.completion.baseline import alignment_baseline

baseline = alignment_baseline("scale, in disparity", kind="scale", space="inverse")
