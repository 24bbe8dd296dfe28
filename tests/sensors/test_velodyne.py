from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from pnpdepth_cli.errors import NoPointsError, UsageError
from pnpdepth_cli.sensors import (
    FORWARD_LEFT_UP,
    Camera,
    as_depth_image,
    project_velodyne,
)

K = np.array([[100.0, 0, 50], [0, 100, 40], [0, 0, 1]])
SIZE = (80, 101)


def camera(**fields: object) -> Camera:
    return Camera(**({"intrinsics": K, "rotation": FORWARD_LEFT_UP} | fields))  # type: ignore[arg-type]


def rotation(x: float, y: float, z: float) -> NDArray[np.float64]:
    """By Rodrigues' formula about the axis (x, y, z), by its length in radians."""
    angle = float(np.linalg.norm([x, y, z]))
    if angle == 0:
        return np.eye(3)
    a, b, c = np.array([x, y, z]) / angle
    cross = np.array([[0, -c, b], [c, 0, -a], [-b, a, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def test_a_scan_projects_as_computed_by_hand() -> None:
    # The scanner (x forward, y left, z up) is 0.5 m left of, 1 m above, 2 m behind the camera.
    posed = camera(translation=np.array([-0.5, -1.0, -2.0]))
    scan = np.array(
        [
            [12.0, 0.0, 0.0, 0.3],  # camera (-0.5, -1, 10): u = 50 - 5, v = 40 - 10
            [7.0, -1.25, -1.5, 0.3],  # camera (0.75, 0.5, 5): u = 50 + 15, v = 40 + 10
            [6.0, -0.58, -1.06, 0.3],  # camera (0.08, 0.06, 4): u = 52, v = 41.5
            [1.0, 0.0, 0.0, 0.3],  # camera z = -1
            [12.0, 9.0, 0.0, 0.3],  # camera (-9.5, ., 10): u = -45
        ]
    )
    got = project_velodyne(scan, posed, SIZE, keep_occluded=True)
    np.testing.assert_allclose(got.xy, [[45, 30], [65, 50], [52, 41.5]], atol=1e-5)
    np.testing.assert_allclose(got.depth, [10, 5, 4], rtol=1e-6)
    assert got.index.tolist() == [0, 1, 2]
    assert got.dropped == {
        "out of range": 0,
        "behind the camera": 1,
        "outside the image": 1,
        "behind another in their pixel": 0,
    }


def test_range_is_the_distance_from_the_camera_instead_of_z() -> None:
    scan = np.array([[4.0, 0.0, -3.0]])  # 3 m below the axis, 4 m ahead
    wide = camera(intrinsics=np.array([[40.0, 0, 50], [0, 40, 40], [0, 0, 1]]))
    assert project_velodyne(scan, wide, SIZE).depth.tolist() == [4]
    assert project_velodyne(scan, wide, SIZE, euclidean=True).depth.tolist() == [5]


def test_of_two_points_on_a_pixel_the_nearer_wins_and_keeps_its_subpixel_position() -> None:
    scan = np.array([[20.0, 0.02, 0.0], [10.0, 0.03, 0.0], [10.0, 1.0, 0.0]])
    got = project_velodyne(scan, camera(), SIZE, keep_occluded=True)
    assert got.index.tolist() == [1, 2]
    np.testing.assert_allclose(got.xy[0], [49.7, 40], atol=1e-5)
    assert got.dropped["behind another in their pixel"] == 1
    assert as_depth_image(got)[40, 50] == 10


def test_minimum_and_maximum_range_are_distances_from_the_scanner() -> None:
    scan = np.array([[3.0, 0, 0], [5.0, 0.5, 0], [9.0, 2.0, 0]])
    ahead = camera(translation=np.array([0, 0, 1.0]))
    got = project_velodyne(scan, ahead, SIZE, limits=(4, 9), keep_occluded=True)
    assert got.index.tolist() == [1]  # the last is 9.2 m away
    assert got.dropped["out of range"] == 2


def test_an_empty_range_is_a_mistake_of_the_user() -> None:
    with pytest.raises(UsageError, match="5 to 5 m is empty"):
        project_velodyne(np.ones((1, 3)), camera(), SIZE, limits=(5, 5))


def test_a_scan_outside_the_image_is_an_error_that_counts_its_points() -> None:
    scan = np.array([[-5.0, 0, 0], [1.0, 50, 0], [1.0, 40, 0]])
    with pytest.raises(NoPointsError, match=r"1 behind the camera, 2 outside the image") as error:
        project_velodyne(scan, camera(), SIZE)
    assert "\n" not in str(error.value)


def test_the_outermost_half_pixels_belong_to_the_image_and_no_more() -> None:
    # u = 50 - 10 y: the left border of the image is at -0.5, the right one at 100.5
    scan = np.array([[10.0, y, 0] for y in (5.0499, 5.0501, -5.0499, -5.0501)])
    assert project_velodyne(scan, camera(), SIZE, keep_occluded=True).index.tolist() == [0, 2]


angles = st.floats(-0.3, 0.3)
offsets = st.floats(-1.5, 1.5)
lens = st.sampled_from(
    [(), (-0.2, 0.03, 0.001, -0.002), (-0.3, 0.1, 0.0, 0.001, -0.02), (0.1,) * 2 + (0.0,) * 6]
)


@settings(deadline=None, max_examples=40)
@given(
    seed=st.integers(0, 2**32 - 1),
    turn=st.tuples(angles, angles, angles),
    move=st.tuples(offsets, offsets, offsets),
    focal=st.floats(60, 900),
    distortion=lens,
)
def test_a_projected_point_unprojects_to_where_it_was(
    seed: int,
    turn: tuple[float, float, float],
    move: tuple[float, float, float],
    focal: float,
    distortion: tuple[float, ...],
) -> None:
    size = (300, 400)
    focal += 300 if distortion else 0  # undistortion settles only so far from the axis
    intrinsics = np.array([[focal, 0.3, 201.7], [0, 1.1 * focal, 148.2], [0, 0, 1]])
    eye = camera(
        intrinsics=intrinsics,
        rotation=rotation(*turn) @ FORWARD_LEFT_UP,
        translation=np.array(move),
        distortion=distortion,
    )
    scan = np.random.default_rng(seed).uniform([-20, -20, -4], [60, 20, 4], (400, 3))
    try:
        got = project_velodyne(scan, eye, size, keep_occluded=True)
    except NoPointsError:
        return
    back = eye.to_scanner(eye.unproject(got.xy.astype(np.float64), got.depth))
    np.testing.assert_allclose(back, scan[got.index], atol=2e-3)
    # and from the middle of its pixel, to where the pixel's rounding allows
    rounded = eye.to_scanner(eye.unproject(np.floor(got.xy + 0.5), got.depth))
    off = np.linalg.norm(rounded - scan[got.index], axis=1)
    assert (off <= 1.6 * got.depth / focal + 1e-3).all()


@settings(deadline=None, max_examples=60)
@given(
    seed=st.integers(0, 2**32 - 1),
    coefficients=st.tuples(*[st.floats(-0.05, 0.05)] * 8).flatmap(
        lambda c: st.sampled_from([c[:4], c[:5], c])
    ),
)
def test_distortion_is_opencvs(seed: int, coefficients: tuple[float, ...]) -> None:
    import cv2

    points = np.random.default_rng(seed).uniform([-4, -4, 8], [4, 4, 30], (50, 3))
    eye = camera(distortion=coefficients)
    ours = eye.pixels_of(points)
    theirs, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, np.array(coefficients))
    np.testing.assert_allclose(ours, theirs[:, 0], atol=1e-8)


def test_a_lens_model_does_not_fold_points_from_outside_into_the_image() -> None:
    # 1 - 0.4 r² turns back at r = 0.91: a point at r = 1.58 would land on the axis
    eye = camera(distortion=(-0.4, 0.0, 0.0, 0.0))
    folded = np.array([[10.0, 15.8, 0.0]])
    assert np.isnan(eye.pixels_of(eye.from_scanner(folded))).all()
    inside = np.array([[10.0, 5.0, 0.0], *folded])
    assert project_velodyne(inside, eye, SIZE, keep_occluded=True).index.tolist() == [0]
