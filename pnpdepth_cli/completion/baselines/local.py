"""The prediction aligned locally."""

from __future__ import annotations

from pnpdepth_cli.completion.baseline import Baseline
from pnpdepth_cli.completion.local_alignment import locally_aligned

baseline = Baseline(
    title="scale and shift around each pixel", of_prediction=locally_aligned, pointwise=True
)
