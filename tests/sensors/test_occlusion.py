"""The occlusion filter, on a scene computed exactly and on frames with ground truth."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from pnpdepth_cli.points import SparsePoints
from pnpdepth_cli.sensors.projection import edge_agreement, hidden_points


@pytest.mark.parametrize("focal_px", [240.0, 300.0])
@pytest.mark.parametrize("origin", [(0.0, 0.0, 0.0), (0.3, -0.1, -0.2)])
def test_a_point_is_hidden_by_a_nearer_one_beside_its_beam(
    origin: tuple[float, float, float], focal_px: float
) -> None:
    rng = np.random.default_rng(0)
    pixels = rng.permutation(24 * 32)[:200]
    xy = np.column_stack([pixels % 32, pixels // 32]) + rng.uniform(-0.49, 0.49, (200, 2))
    depth = rng.choice([2.0, 2.1, 3.0, 5.0, 20.0], 200)
    scanner = np.array([[focal_px, 0, 15.5], [0, focal_px, 11.5], [0, 0, 1]]) @ origin
    expected = np.zeros(200, bool)
    reach, margin = max(1, round(np.radians(0.8) * focal_px)), np.radians(0.24) * focal_px
    for (i, far), (j, near) in itertools.product(enumerate(depth), repeat=2):
        apart = np.floor(xy[j] + 0.5) - np.floor(xy[i] + 0.5)
        if near < 0.92 * far and np.abs(apart).max() <= reach:
            along = (near - scanner[2]) / (far - scanner[2])  # of the beam, from the scanner
            passes = ((1 - along) * scanner[:2] + along * far * xy[i]) / near
            beam = passes - xy[i] if 0 < along < 1 else np.zeros(2)
            expected[i] |= np.hypot(*(apart - beam / 2)) <= margin + 0.75 * np.hypot(*beam)
    hidden = hidden_points(xy, depth, (24, 32), focal_px=focal_px, scanner=scanner)
    assert hidden.tolist() == expected.tolist()
    assert 0.1 < expected.mean() < 0.9


@pytest.mark.parametrize(("edge", "agreement"), [(50, 0.81), (20, -0.11), (None, 0.0)])
def test_edges_agree_where_they_are_beside_jumps_of_depth(
    edge: int | None, agreement: float
) -> None:
    y, x = np.mgrid[2:60:4, 2:100:4]
    xy = np.column_stack([x.ravel(), y.ravel()]).astype(np.float32)
    depth = np.where((xy[:, 0] < 50) & (edge is not None), 2, 5).astype(np.float32)
    rgb = np.zeros((60, 100, 3), np.float32)
    rgb[:, edge:] = 1
    points = SparsePoints(xy=xy, depth=depth, size=(60, 100))
    assert edge_agreement(points, rgb) == pytest.approx(agreement, abs=0.005)
    assert edge_agreement(points.select(slice(9, 15)), rgb) == 0  # too few to tell
