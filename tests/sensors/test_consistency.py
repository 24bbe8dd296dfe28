"""Views of one scene agree on its depth, and one that is wrong agrees with none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pnpdepth_cli.camera import Camera
from pnpdepth_cli.sensors.point_cloud import View, consistent_depth, neighbouring_views

SIZE = (36, 48)
CAMERA = Camera(intrinsics=np.array([[40.0, 0, 23.5], [0, 40, 17.5], [0, 0, 1]]))


def view_of_a_wall(x: float, scale: float = 1.0) -> View:
    """A camera at (x, 0, 0) before the wall z = 5 + 0.2 x."""
    columns = np.broadcast_to((np.arange(SIZE[1]) - 23.5) / 40, SIZE)
    depth = (5 + 0.2 * x) / (1 - 0.2 * columns)
    pose = np.column_stack([np.eye(3), [x, 0, 0]])
    return View(depth=(scale * depth).astype(np.float32), camera=CAMERA, pose=pose)


def test_views_of_one_surface_keep_the_depth_where_they_overlap() -> None:
    here, other = view_of_a_wall(0.0), view_of_a_wall(0.5)
    kept = consistent_depth(here, [other], 2)
    assert (kept[:, :2] == 0).all()  # the other camera stands to the right
    assert (kept[:, 6:] > 0).all()
    known = kept > 0
    np.testing.assert_allclose(kept[known], here.depth[known], rtol=0.005)


def test_a_wrong_view_is_outvoted_and_does_not_move_the_mean() -> None:
    here, right, wrong = view_of_a_wall(0.0), view_of_a_wall(0.4), view_of_a_wall(0.2, 1.2)
    kept = consistent_depth(here, [right, wrong], 2)
    known = kept > 0
    assert known.mean() > 0.8
    np.testing.assert_allclose(kept[known], here.depth[known], rtol=0.005)
    assert not consistent_depth(wrong, [here, right], 2).any()
    assert not consistent_depth(here, [right, wrong], 3).any()


def test_a_pixel_that_is_unknown_or_occluded_elsewhere_is_left_out() -> None:
    here, other = view_of_a_wall(0.0), view_of_a_wall(0.0)
    depth = other.depth.copy()
    depth[:10], depth[10:20], depth[20:25] = 0, 1.0, np.inf
    kept = consistent_depth(here, [replace(other, depth=depth)], 2)
    assert not kept[:25].any()
    np.testing.assert_allclose(kept[25:], here.depth[25:], rtol=1e-6)


def test_neighbours_are_the_nearest_that_look_the_same_way() -> None:
    back = np.diag([-1.0, 1, -1])
    turns = [np.eye(3), np.eye(3), back, np.eye(3)]
    poses = np.stack(
        [np.column_stack([turn, [x, 0, 0]]) for turn, x in zip(turns, (0, 3, 1, 2), strict=True)]
    )
    assert neighbouring_views(poses, 0) == [3, 1]
    assert neighbouring_views(poses, 2) == []
