"""The prediction times a scale."""

from __future__ import annotations

from pnpdepth_cli.completion.baseline import alignment_baseline

baseline = alignment_baseline("scale", kind="scale", space="depth")
