from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pnpdepth_cli.camera import Camera
from pnpdepth_cli.choices import LENSES
from pnpdepth_cli.sensors.lens import distort, largest_radius, pixels_of, rays_of_image, undistort

K = np.array([[420.0, 0, 320], [0, 410, 240], [0, 0, 1]])
small = st.floats(-0.05, 0.05)
EXAMPLES: dict[str, tuple[float, ...]] = {
    "radial-tangential": (-0.2, 0.05, 0.001, -0.002, 0.01),
    "fisheye": (-0.02, 0.01, -0.003, 0.001),
}


@settings(max_examples=60)
@given(
    seed=st.integers(0, 2**32 - 1),
    coefficients=st.tuples(*[small] * 14).flatmap(
        lambda c: st.sampled_from([c[:4], c[:5], c[:8], c[:12], c])
    ),
)
def test_points_are_seen_where_opencv_sees_them_through_each_lens(
    seed: int, coefficients: tuple[float, ...]
) -> None:
    xy = np.random.default_rng(seed).uniform(-0.6, 0.6, (60, 2))
    points = 3 * np.column_stack([xy, np.ones(60)])
    camera = Camera(intrinsics=K, distortion=coefficients)
    still = np.zeros(3)
    theirs, _ = cv2.projectPoints(points, still, still, K, np.array(coefficients))
    np.testing.assert_allclose(pixels_of(camera, points), theirs[:, 0], atol=1e-6)
    four = coefficients[:4]
    camera = Camera(intrinsics=K, distortion=four, lens="fisheye")
    theirs, _ = cv2.fisheye.projectPoints(points[:, None], still, still, K, np.array(four))
    np.testing.assert_allclose(pixels_of(camera, points), theirs[:, 0], atol=1e-6)


@pytest.mark.parametrize("lens", LENSES)
def test_undoing_a_lens_gives_the_directions_back_and_the_rays_of_an_image(lens: str) -> None:
    turn = np.linspace(0, 40, 99)
    out = np.linspace(0, 5, 99)  # from the axis to 79 degrees
    plane = np.column_stack([out * np.cos(turn), out * np.sin(turn)])
    shown = distort(plane, lens, EXAMPLES[lens])
    assert np.abs(shown - plane).max() > 0.1
    np.testing.assert_allclose(undistort(shown, lens, EXAMPLES[lens]), plane, rtol=0, atol=1e-12)
    camera = Camera(intrinsics=K, lens=lens, distortion=EXAMPLES[lens])
    rays = rays_of_image(camera, (5, 7)).reshape(-1, 2)
    pixels = pixels_of(camera, np.column_stack([rays, np.ones(35)]))
    np.testing.assert_allclose(pixels, np.indices((5, 7))[::-1].reshape(2, -1).T, atol=1e-6)


def test_a_lens_that_turns_back_shows_nothing_beyond() -> None:
    turns_back = (-0.2, 0.0, 0.0, 0.0)  # angle − 0.2 angle³ has its maximum at 1.29 radians
    assert largest_radius("fisheye", turns_back) == pytest.approx(np.tan(1.29), rel=0.01)
    beyond, *shown = distort(np.array([[4.0, 0], [3.0, 0], [1.0, 0]]), "fisheye", turns_back)
    assert np.isnan(beyond).all()
    angle = np.arctan([3.0, 1.0])
    np.testing.assert_allclose(shown, np.column_stack([angle - 0.2 * angle**3, [0, 0]]))
    barrel = (-0.4, 0.0, 0.0, 0.0)  # r − 0.4 r³ has its maximum of 0.61 at 0.91
    plane = undistort(np.array([[0.7, 0.0], [0.5, 0.3]]), "radial-tangential", barrel)
    assert np.isnan(plane[0]).all()
    np.testing.assert_allclose(distort(plane[1:], "radial-tangential", barrel), [[0.5, 0.3]])
