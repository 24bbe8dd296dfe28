"""A depth map's cloud lies on the surfaces of the scene and ends at their silhouettes."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pnpdepth_cli.camera import Camera
from pnpdepth_cli.sensors.point_cloud import (
    PointCloud,
    View,
    cloud_from_depth,
    consistent_depth,
    depth_edges,
    merge_in_voxels,
    neighbouring_views,
    points_of_depth,
)

HEIGHT, WIDTH = 24, 32
CAMERA = Camera(intrinsics=np.array([[30.0, 0, 15.5], [0, 28.0, 11.0], [0, 0, 1]]))


def joined(clouds: Iterable[PointCloud]) -> PointCloud:
    xyz, normals, rgb = zip(*clouds, strict=True)
    colours = None if rgb[0] is None else np.concatenate(rgb)
    return PointCloud(xyz=np.concatenate(xyz), normals=np.concatenate(normals), rgb=colours)


@settings(max_examples=25, deadline=None)
@given(st.floats(-0.4, 0.4), st.floats(-0.4, 0.4), st.floats(0.5, 20))
def test_a_plane_has_its_normal_everywhere_and_no_edge(a: float, b: float, distance: float) -> None:
    normal = np.array([a, b, 1.0]) / np.linalg.norm([a, b, 1.0])
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    rays = np.stack([(columns - 15.5) / 30, (rows - 11) / 28, np.ones((HEIGHT, WIDTH))], -1)
    depth = (distance / (rays @ normal)).astype(np.float32)
    cloud = joined(cloud_from_depth(depth, CAMERA))
    assert len(cloud.xyz) == HEIGHT * WIDTH
    assert cloud.xyz @ normal == pytest.approx(np.full(len(cloud.xyz), distance), rel=1e-4)
    assert cloud.normals @ -normal == pytest.approx(np.ones(len(cloud.xyz)), abs=1e-3)


def test_both_sides_of_a_jump_are_left_out_and_nothing_else() -> None:
    depth = np.full((HEIGHT, WIDTH), 4, np.float32)
    depth[:, 20:] = 2
    expected = np.zeros_like(depth, bool)
    expected[:, 19:21] = True
    assert (depth_edges(depth) == expected).all()
    assert len(joined(cloud_from_depth(depth, CAMERA)).xyz) == HEIGHT * (WIDTH - 2)


def test_unknown_pixels_have_no_point_and_a_pose_moves_the_others() -> None:
    depth = np.full((HEIGHT, WIDTH), 3, np.float32)
    depth[8, 4] = 0
    depth[5, 6] = np.inf
    cloud = joined(cloud_from_depth(depth, CAMERA))
    assert len(cloud.xyz) == HEIGHT * WIDTH - 2
    assert (cloud.xyz[:, 2] == 3).all()
    turn = np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])
    moved = cloud.transform(np.column_stack([turn, [1.0, 2, 3]]))
    assert moved.xyz == pytest.approx(cloud.xyz @ turn.T + [1, 2, 3], abs=1e-5)
    assert moved.normals == pytest.approx(np.tile([-1.0, 0, 0], (len(cloud.xyz), 1)), abs=1e-5)


def test_merged_clouds_have_one_mean_point_per_voxel() -> None:
    rng = np.random.default_rng(2)
    normals = np.tile(np.float32([0, 0, -1]), (500, 1))
    clouds = []
    for _ in range(3):
        xyz = rng.uniform(-1, 1, (500, 3)).astype(np.float32)
        rgb = rng.integers(0, 256, (500, 3), dtype=np.uint8)
        clouds.append(PointCloud(xyz=xyz, rgb=rgb, normals=normals))
    merged = merge_in_voxels(clouds, 0.5)
    every = joined(clouds)
    cells = np.floor(every.xyz / 0.5)
    assert len(merged.xyz) == len(np.unique(cells, axis=0))
    first = (cells == np.floor(merged.xyz[0] / 0.5)).all(axis=1)
    assert merged.xyz[0] == pytest.approx(every.xyz[first].mean(axis=0), abs=1e-6)
    assert merged.rgb[0] == pytest.approx(every.rgb[first].mean(axis=0), abs=0.51)


WALL_SIZE = (36, 48)
WALL_CAMERA = Camera(intrinsics=np.array([[40.0, 0, 23.5], [0, 40, 17.5], [0, 0, 1]]))


def depth_of_a_wall(x: float) -> np.ndarray:
    """What a camera at (x, 0, 0) sees of the wall z = 5 + 0.2 x."""
    columns = np.broadcast_to((np.arange(WALL_SIZE[1]) - 23.5) / 40, WALL_SIZE)
    return ((5 + 0.2 * x) / (1 - 0.2 * columns)).astype(np.float32)


def view_at(x: float, depth: np.ndarray) -> View:
    points = points_of_depth(depth, WALL_CAMERA).astype(np.float32)
    return points, WALL_CAMERA, np.column_stack([np.eye(3), [x, 0, 0]])


def test_a_wrong_view_is_outvoted_and_does_not_move_the_mean() -> None:
    depth = depth_of_a_wall(0.0)
    here = view_at(0.0, depth)
    right = view_at(0.4, depth_of_a_wall(0.4))
    wrong = view_at(0.2, np.float32(1.2) * depth_of_a_wall(0.2))
    kept = consistent_depth(here, [right, wrong], 2)
    known = kept > 0
    assert known.mean() > 0.8
    np.testing.assert_allclose(kept[known], depth[known], rtol=0.005)
    assert not consistent_depth(wrong, [here, right], 2).any()
    assert not consistent_depth(here, [right, wrong], 3).any()


def test_a_pixel_that_is_unknown_occluded_or_outside_elsewhere_is_left_out() -> None:
    depth = depth_of_a_wall(0.0)
    here = view_at(0.0, depth)
    other = depth.copy()
    other[:10] = 0
    other[10:20] = 1.0
    other[20:25] = np.inf
    kept = consistent_depth(here, [view_at(0.0, other)], 2)
    assert not kept[:25].any()
    np.testing.assert_allclose(kept[25:], depth[25:], rtol=1e-6)
    aside = consistent_depth(here, [view_at(0.5, depth_of_a_wall(0.5))], 2)
    assert (aside[:, :2] == 0).all()  # the other camera stands to the right
    assert (aside[:, 6:] > 0).all()


def test_neighbours_are_the_nearest_that_look_the_same_way() -> None:
    back = np.diag([-1.0, 1, -1])
    places = ((np.eye(3), 0), (np.eye(3), 3), (back, 1), (np.eye(3), 2))
    poses = np.stack([np.column_stack([turn, [x, 0, 0]]) for turn, x in places])
    assert neighbouring_views(poses, 0) == [3, 1]
    assert neighbouring_views(poses, 2) == []
