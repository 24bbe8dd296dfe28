"""The predicted disparity times a scale plus a shift."""

from __future__ import annotations

from pnpdepth_cli.completion.baseline import alignment_baseline

baseline = alignment_baseline("scale and shift, in disparity", kind="affine", space="inverse")
