"""The motion of a camera between two frames, estimated where no pose is known.

SIFT keypoints of both images are matched (Lowe, "Distinctive image features from scale-invariant
keypoints", 2004). Those of the other frame get depth from its sparse points. The
perspective-n-point problem is solved in RANSAC (Fischler and Bolles, 1981). The frame's own depth
takes no part in it. An estimate that few matches support is refused.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.camera import Camera
from pnpdepth_cli.sensors.lens import rays_of, unproject
from pnpdepth_cli.sensors.pixels import Floats, Mask, Points

_MIN_INLIERS = 30
"""Matches that agree with the motion; fewer support no estimate."""
_MIN_FRACTION = 0.25
"""Least fraction of the matches that agrees with the motion."""

_KEYPOINTS = 3000
_RATIO = 0.8  # Lowe's, of the distances to the nearest and the next descriptor
_REPROJECTION_PX = 2.0
_REACH = 1.2  # mean spacings of the points, from a keypoint to the nearest
_JUMP = 1.1  # ratio of depths of the points around a keypoint


class Keypoints(NamedTuple):
    """SIFT keypoints of an image: (K, 2) pixel coordinates and (K, 128) descriptors."""

    xy: Floats
    descriptors: NDArray[np.float32]


def keypoints_of(rgb: NDArray[np.float32]) -> Keypoints:
    """Returns the keypoints of an image (H, W, 3) in 0…1."""
    grey = cv2.cvtColor((rgb * 255).round().astype(np.uint8), cv2.COLOR_RGB2GRAY)
    # OpenCV's annotations lack SIFT
    keypoints, descriptors = cv2.SIFT_create(nfeatures=_KEYPOINTS).detectAndCompute(grey, None)  # type: ignore[attr-defined, unused-ignore]
    if descriptors is None:
        return Keypoints(np.empty((0, 2)), np.empty((0, 128), np.float32))
    return Keypoints(np.array([each.pt for each in keypoints], np.float64), descriptors)


def motion_of_images(
    here: Keypoints, there: Keypoints, points: Points, camera: Camera
) -> tuple[Floats | None, str]:
    """Returns the motion from the other frame's camera to this one's, from matched keypoints.

    The points are the sparse depth of the other frame; both have the same camera. The motion is
    (3, 4) in metres, and None if it is refused. The text says what supports it, or why it is.
    """
    at, to = _matches(here, there)
    depth, known = _depth_at(points, at)
    at, to, depth = at[known], to[known], depth[known]
    if len(at) < _MIN_INLIERS:
        return None, f"{len(at)} matches with depth, at least {_MIN_INLIERS} needed"
    focal_px = float(camera.intrinsics[0, 0])
    rays = rays_of(camera, to)
    solved, turn, shift, index = cv2.solvePnPRansac(
        unproject(camera, at, depth), rays, np.eye(3), None, iterationsCount=1000,
        reprojectionError=_REPROJECTION_PX / focal_px, confidence=0.9999,
        flags=cv2.SOLVEPNP_SQPNP,
    )  # fmt: skip
    inliers = np.empty(0, np.intp) if not solved or index is None else index.ravel()
    basis = f"{len(inliers)} of {len(at)} matches of the images"
    if len(inliers) < max(_MIN_INLIERS, _MIN_FRACTION * len(at)):
        return None, f"{basis} agree"
    xyz = unproject(camera, at[inliers], depth[inliers])
    turn, shift = cv2.solvePnPRefineLM(xyz, rays[inliers], np.eye(3), None, turn, shift)
    motion = np.column_stack([cv2.Rodrigues(turn)[0], shift])
    length, median = float(np.linalg.norm(motion[:, 3])), float(np.median(points.depth))
    if not length <= median:
        return None, f"{length:.1f} m of motion at a median depth of {median:.1f} m"
    return motion, basis


def _matches(here: Keypoints, there: Keypoints) -> tuple[Floats, Floats]:
    """(M, 2) keypoints of the other image, and (M, 2) their partners in this one."""
    if min(len(here.xy), len(there.xy)) < 2:
        return np.empty((0, 2)), np.empty((0, 2))
    pairs = cv2.BFMatcher(cv2.NORM_L2).knnMatch(there.descriptors, here.descriptors, k=2)
    clear = [best for best, second in pairs if best.distance < _RATIO * second.distance]
    return there.xy[[m.queryIdx for m in clear]], here.xy[[m.trainIdx for m in clear]]


def _depth_at(points: Points, xy: Floats) -> tuple[Floats, Mask]:
    """Depth (M,) of the points around each pixel, and where it is known.

    Inverse depth is the mean of theirs, weighted by nearness.
    """
    from scipy.spatial import cKDTree

    if len(points) < _MIN_INLIERS or not len(xy):
        return np.zeros(len(xy)), np.zeros(len(xy), bool)
    height, width = points.size
    spacing = np.sqrt(height * width / len(points))
    distance, near = cKDTree(points.xy).query(xy, k=4)
    around = points.depth[near].astype(np.float64)
    smooth = around.max(axis=1) < _JUMP * around.min(axis=1)
    weights = 1 / np.maximum(distance, 1e-3)
    depth = weights.sum(axis=1) / (weights / around).sum(axis=1)
    return depth, smooth & (distance[:, 0] < _REACH * spacing)
