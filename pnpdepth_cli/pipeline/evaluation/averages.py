"""Means over frames: every frame counts alike, or every pixel."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pnpdepth_cli.core.metrics import measures_of

Floats = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class FrameTable:
    """The scores of N frames, from which the means of any weighting of the frames follow."""

    rows: Floats
    """(N, M) measures of each frame; where pixels are pooled, (N, len(SUMS)) sums over pixels."""
    pooled: bool = False
    """True if the mean is over the pixels of all frames."""
    gaps: bool = False
    """True if a frame may lack a measure (NaN), which then is in no mean of this measure."""
    kept: tuple[int, ...] | None = None
    """Of a pooled table: which of core.metrics.MEASURES the means are; None for all."""

    def mean(self) -> Floats:
        """Returns (M,) the means over all frames."""
        totals = self.cluster_totals(np.zeros(len(self.rows), np.int64))[0]
        return np.asarray(self.means_of(torch.from_numpy(totals)).numpy())

    def cluster_totals(self, clusters: NDArray[np.int64]) -> Floats:
        """Returns (G, C) the sums of the rows of each cluster, and in the last column its frames.

        With gaps, the last M columns are the frames that have each measure.

        Args:
            clusters: (N,) the cluster of each frame, from 0 to G − 1.
        """
        if self.gaps:
            known = ~np.isnan(self.rows)
            rows = np.column_stack([np.where(known, self.rows, 0), known])
        else:
            rows = np.column_stack([self.rows, np.ones(len(self.rows))])
        totals = np.zeros((int(clusters.max()) + 1, rows.shape[1]))
        np.add.at(totals, clusters, rows)
        return totals

    def means_of(self, totals: Tensor) -> Tensor:
        """Returns (…, M) the means of frames whose `cluster_totals` add up to (…, C)."""
        if self.pooled:
            means = measures_of(totals[..., :-1])
            return means if self.kept is None else means[..., list(self.kept)]
        measures = self.rows.shape[1] if self.gaps else -1
        return totals[..., :measures] / totals[..., measures:]
