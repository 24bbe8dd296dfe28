"""The score of points on an image's edges: where it is high, and its spread by chance."""

from __future__ import annotations

import numpy as np
import pytest

from pnpdepth_cli.sensors.edge_fit import edge_map, jump_weights
from pnpdepth_cli.sensors.projection import Points

SIZE = (240, 320)


def boxes(seed: int = 0) -> tuple[np.ndarray, Points]:
    """An image with boxes before a wall, and points of both."""
    rng = np.random.default_rng(seed)
    rgb = np.full((*SIZE, 3), 0.5, np.float32)
    depth = np.full(SIZE, 10.0, np.float32)
    for near in (7, 5, 3):
        top = rng.integers(10, 150)
        left = rng.integers(10, 230)
        rgb[top : top + 60, left : left + 60] = rng.uniform(size=3)
        depth[top : top + 60, left : left + 60] = near
    rgb += rng.normal(0, 0.02, rgb.shape).astype(np.float32)
    y, x = (coordinates.ravel() for coordinates in np.mgrid[4:240:5, 2:320:2])
    xy = np.column_stack([x, y]).astype(np.float32)
    return rgb.clip(0, 1), Points(xy=xy, depth=depth[y, x], size=SIZE)


def test_points_that_belong_to_an_image_stand_out_and_a_shift_is_found() -> None:
    rgb, points = boxes()
    weight = jump_weights(points)
    edges = edge_map(rgb)
    assert weight is not None
    assert weight.mean() == pytest.approx(0, abs=1e-9)
    assert np.linalg.norm(weight) == pytest.approx(1)
    off = points.xy + np.array([12.0, -8.0])
    shifted = edges.shifted(off, weight, (40.0, 40.0))
    spread = shifted.std()
    assert (edges.score(points.xy, weight) - shifted.mean()) / spread > 5
    assert (edges.score(off, weight) - shifted.mean()) / spread < 2.5
    row, column = np.unravel_index(shifted.argmax(), shifted.shape)
    middle = np.array(shifted.shape) // 2
    np.testing.assert_allclose((row, column) - middle, (8, -12), atol=5)


def test_an_image_of_something_else_has_no_score_but_chances() -> None:
    _, points = boxes()
    weight = jump_weights(points)
    assert weight is not None
    for seed in range(1, 6):
        edges = edge_map(boxes(seed)[0])
        shifted = edges.shifted(points.xy, weight, (40.0, 40.0))
        assert (edges.score(points.xy, weight) - shifted.mean()) / shifted.std() < 4


def test_points_without_jumps_tell_nothing() -> None:
    _, points = boxes()
    flat = Points(xy=points.xy, depth=np.full(len(points), 5, np.float32), size=SIZE)
    assert jump_weights(flat) is None
    assert jump_weights(points.select(slice(0, 10))) is None
