"""Baselines: each file defines `baseline`, a `Baseline`."""
