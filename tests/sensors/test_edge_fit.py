"""The score of jumps of depth on an image's edges: where it is high, and its spread by chance."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from pnpdepth_cli.camera import SAME_PLACE, Camera, Extrinsics
from pnpdepth_cli.sensors.edge_fit import edge_map, jumps_of

SIZE = (240, 320)
CAMERA = Camera(intrinsics=np.array([[300.0, 0, 159.5], [0, 300, 119.5], [0, 0, 1]]))


def boxes(seed: int = 0) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    """An image with boxes before a wall, and a scan of both from the camera's place."""
    rng = np.random.default_rng(seed)
    rgb = np.full((*SIZE, 3), 0.5, np.float32)
    depth = np.full(SIZE, 10.0)
    for near in (7, 5, 3):
        top = rng.integers(10, 150)
        left = rng.integers(10, 230)
        rgb[top : top + 60, left : left + 60] = rng.uniform(size=3)
        depth[top : top + 60, left : left + 60] = near
    rgb += rng.normal(0, 0.02, rgb.shape).astype(np.float32)
    y, x = (index.ravel() for index in np.mgrid[4:240:5, 2:320:2])
    rays = np.column_stack([(x - 159.5) / 300, (y - 119.5) / 300, np.ones(len(x))])
    return rgb.clip(0, 1), rays * depth[y, x, None]


def test_a_scan_that_belongs_to_an_image_stands_out_and_a_shift_is_found() -> None:
    rgb, scan = boxes()
    edges = edge_map(rgb)
    jumps = jumps_of(scan, CAMERA, SAME_PLACE, SIZE)
    assert jumps is not None
    assert np.linalg.norm(jumps.weights) == pytest.approx(1)
    xy, weights = jumps.projected(CAMERA)
    off = xy + np.array([12.0, -8.0])
    shifted = edges.shifted(off, weights, (40.0, 40.0))
    assert (edges.score(xy, weights) - shifted.mean()) / shifted.std() > 5
    assert (edges.score(off, weights) - shifted.mean()) / shifted.std() < 2.5
    row, column = np.unravel_index(shifted.argmax(), shifted.shape)
    middle = np.array(shifted.shape) // 2
    np.testing.assert_allclose((row, column) - middle, (8, -12), atol=3)


def test_an_image_of_something_else_has_no_score_but_chances() -> None:
    jumps = jumps_of(boxes()[1], CAMERA, SAME_PLACE, SIZE)
    assert jumps is not None
    xy, weights = jumps.projected(CAMERA)
    scores = []
    for seed in range(1, 8):  # a side of one box may lie on another's, but not of most
        edges = edge_map(boxes(seed)[0])
        shifted = edges.shifted(xy, weights, (40.0, 40.0))
        scores.append((edges.score(xy, weights) - shifted.mean()) / shifted.std())
    assert np.median(scores) < 3


def test_jumps_are_those_that_the_scanner_sees_wherever_the_camera_is() -> None:
    _, scan = boxes()
    here = jumps_of(scan, CAMERA, SAME_PLACE, SIZE)
    back = Extrinsics(np.eye(3), np.array([0.0, 0.0, 2.0]))  # all stays in the image
    there = jumps_of(scan, CAMERA, back, SIZE)
    assert here is not None
    assert there is not None
    np.testing.assert_allclose(there.moved(back.inverse()).xyz, here.xyz, atol=1e-9)


def test_points_without_jumps_tell_nothing() -> None:
    _, scan = boxes()
    flat = scan * (5 / scan[:, 2:])
    assert jumps_of(flat, CAMERA, SAME_PLACE, SIZE) is None
    assert jumps_of(scan[:10], CAMERA, SAME_PLACE, SIZE) is None
