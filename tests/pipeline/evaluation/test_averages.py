"""Means over frames: of each frame alike, of each pixel alike, and of clusters of frames."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from pnpdepth_cli.core.metrics import error_sums, score
from pnpdepth_cli.pipeline.evaluation.resampling import FrameTable


def test_the_mean_of_frames_counts_each_alike() -> None:
    table = FrameTable(rows=np.array([[1.0, 10.0], [3.0, 30.0]]))
    assert table.mean().tolist() == [2, 20]


def test_cluster_totals_add_rows_and_count_frames() -> None:
    table = FrameTable(rows=np.array([[1.0, 10.0], [3.0, 30.0], [5.0, 20.0]]))
    totals = table.cluster_totals(np.array([1, 0, 1]))
    assert totals.tolist() == [[3, 30, 1], [6, 30, 2]]
    assert table.means_of(torch.from_numpy(totals)).tolist() == [[3, 30], [3, 15]]
    assert table.means_of(torch.from_numpy(totals.sum(axis=0))).tolist() == table.mean().tolist()


def test_the_pooled_mean_counts_each_pixel_alike() -> None:
    generator = torch.Generator().manual_seed(0)
    frames = [torch.rand(2, n, generator=generator) + 1 for n in (3, 50)]
    rows = np.array([error_sums(p, g)[0].tolist() for p, g in frames])
    together = torch.cat(frames, dim=1)
    expected = score(together[0], together[1])
    table = FrameTable(rows=rows, pooled=True)
    assert table.mean()[0] == pytest.approx(expected.rmse, rel=1e-12)
    assert table.mean()[9] == pytest.approx(expected.delta1, rel=1e-12)
    totals = torch.from_numpy(table.cluster_totals(np.array([0, 0])))
    assert table.means_of(totals)[0].tolist() == table.mean().tolist()
