"""Points of neighbouring scans, moved into a frame by the camera's motion.

The motion is corrected until the surfaces of both scans coincide, by point-to-plane registration
(Chen and Medioni, "Object modelling by registration of multiple range images", 1992) with the
weights of Geman and McClure. Distances are fractions of the depth, as errors of the sensor and of
the pose are.

A moved point is compared with the measured points of the frame. It is kept where the nearest, or
two of the nearest four, have about the same depth, and where none close by contradicts it. So three
kinds of points are dropped: of something that has moved since, occluded in the frame, and seen
through by the frame's own scanner. Scans nearer in time count more. A point is dropped where a
point of the frame, or of a scan nearer in time, lies within as many pixels as frames are between.

Where no pose is known, the motion is estimated. SIFT keypoints of both images are matched (Lowe,
"Distinctive image features from scale-invariant keypoints", 2004). Those of the other frame get
depth from its sparse points. The perspective-n-point problem is solved in RANSAC (Fischler and
Bolles, 1981). The frame's own depth takes no part in it. An estimate that few matches support is
refused.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from pnpdepth_cli.camera import Camera, Floats
from pnpdepth_cli.sensors.lens import rays_of, unproject
from pnpdepth_cli.sensors.projection import Mask, Points, points_in_image

# Which moved points agree with the measured ones around them.
_TOLERANCE = 0.05
"""Difference of log depth to a measured point that agrees; chosen on frames 2 and 4 of a KITTI
drive."""
_CONTRADICTION = 0.1
"""Difference of log depth to a measured point that contradicts; chosen on frames 0, 2, 4 and 6 of
the drive."""
_CLOSE = (0.55, 0.37)
"""Distance across and down within which a measured point contradicts, in mean spacings; chosen on
the same frames. Down it is less, as the next scan line of a LiDAR lies at another depth."""
_COMPARED = 4  # nearest measured points that may agree with a moved one
_AGREEING = 2  # that agree, of those, where the nearest one does not
_CONTRADICTING = 12  # nearest measured points, of which none may contradict

# The registration of a scan to the planes of the frame's own.
_MIN_PLANES = 200  # pairs of a point and a plane; with fewer the motion is not corrected
_STEPS = 8
_NEIGHBOURS = 8  # points that a plane is fitted to,
_NEAR = 0.1  # whose depth differs by this fraction at most,
_FLAT = 0.02  # and whose smallest variance is below this fraction of the next
_REACH = 1.2  # mean spacings of the points, between a point and the one it is compared with
_LEAST_ERROR = 2e-4  # typical distance, fraction of the depth
_NORMAL_MEDIAN = 1.4826  # standard deviation over median of |x|, normal errors

# The motion of images, estimated where no pose is known.
_MIN_INLIERS = 30  # matches that agree with it; fewer support none
_MIN_FRACTION = 0.25  # of the matches that agree with it
_KEYPOINTS = 3000
_RATIO = 0.8  # of the distances to the nearest and the next descriptor, as Lowe has it
_ITERATIONS = 1000  # of RANSAC
_CONFIDENCE = 0.9999  # that RANSAC tried a set of inliers
_REPROJECTION_PX = 2.0
_JUMP = 1.1  # ratio of depths of the points around a keypoint
_LEAST_DISTANCE_PX = 1e-3  # between a keypoint and a point, so that its weight is finite


Scan = tuple[Points, Floats]
"""The points of another frame in its image, and (3, 4) the motion from its camera to this one."""
Keypoints = tuple[Floats, NDArray[np.float32]]
"""(K, 2) pixel coordinates and (K, 128) descriptors of SIFT."""


def _spacing_px(points: Points) -> float:
    """Side of the square that each point has in the mean, in pixels."""
    return float(np.sqrt(points.size[0] * points.size[1] / len(points)))


def accumulate(points: Points, neighbours: Mapping[int, Sequence[Scan]], camera: Camera) -> Points:
    """Returns the frame's own points followed by those of its neighbours that agree with them.

    The neighbours are by the number of frames, at least 1, that are between them and this one.
    """
    result = points
    for apart, scans in sorted(neighbours.items()):
        # The points of the neighbours that are so many frames away, where this frame has them.
        moved = []
        for neighbour, motion in scans:
            xyz = unproject(camera, neighbour.xy, neighbour.depth)
            refined = refine_motion(points, xyz, motion, camera)
            moved.append(xyz @ refined[:, :3].T + refined[:, 3])
        # Those join that agree with measured points, where none is known so far.
        xyz, xy = points_in_image(np.concatenate(moved), camera, points.size)
        agrees = _agrees(xy, xyz[:, 2], points)
        xy = xy[agrees]
        depth = xyz[agrees, 2]
        free = cKDTree(result.xy).query(xy)[0] >= apart
        result = replace(
            result,
            xy=np.concatenate([result.xy, xy[free].astype(np.float32)]),
            depth=np.concatenate([result.depth, depth[free].astype(np.float32)]),
        )
    return result


def _agrees(xy: Floats, depth: Floats, measured: Points) -> Mask:
    """(M,) true where a moved point agrees with the measured points around it."""
    near = _nearest(cKDTree(measured.xy), xy, _CONTRADICTING)
    difference = np.abs(np.log(depth[:, None] / measured.depth[near]))
    # The nearest one agrees with it, or several of the nearest do.
    alike = difference[:, :_COMPARED] <= _TOLERANCE
    supported = alike[:, 0] | (alike.sum(axis=1) >= _AGREEING)
    # None that is close in the image has quite another depth.
    offset = np.abs(measured.xy[near] - xy[:, None]) / _spacing_px(measured)
    is_close = (offset <= _CLOSE).all(axis=2)
    contradicted = (is_close & (difference > _CONTRADICTION)).any(axis=1)
    agrees: Mask = supported & ~contradicted
    return agrees


def _nearest(tree: cKDTree, xy: NDArray[np.floating], count: int) -> NDArray[np.intp]:
    """(M, K) numbers of the measured points nearest to pixels: `count`, or all if there are fewer.

    There may be no pixels, as of a neighbour that sees nothing of the frame's view.
    """
    ranks = np.arange(1, min(count, tree.n) + 1)  # a list of ranks gives a row for each pixel
    _, near = tree.query(xy, k=ranks)
    return np.asarray(near, np.intp)


def _planes(points: Points, xyz: Floats, tree: cKDTree) -> tuple[Floats, Mask]:
    """Unit normals (N, 3) of the planes through the neighbours of each point, and which are flat.

    The points are `xyz` (N, 3) in the camera's coordinates; the tree is of their pixels.
    """
    near = _nearest(tree, points.xy, _NEIGHBOURS)
    # The normal is the direction in which the neighbours vary least.
    around = xyz[near] - xyz[near].mean(axis=1, keepdims=True)
    variance, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", around, around))
    jump = np.abs(np.log(points.depth[near] / points.depth[:, None])).max(axis=1)
    flat = (variance[:, 0] < _FLAT * variance[:, 1]) & (jump < _NEAR)
    return axes[:, :, 0], flat


def refine_motion(measured: Points, xyz: Floats, motion: Floats, camera: Camera) -> Floats:
    """Returns the motion (3, 4) that puts points on measured surfaces; the given one if that fails.

    The points (M, 3) are in the other camera's coordinates. The motion leads from there to the
    camera that measured the surfaces.
    """
    reach = _REACH * _spacing_px(measured)
    tree = cKDTree(measured.xy)
    surface = unproject(camera, measured.xy, measured.depth)
    normals, flat = _planes(measured, surface, tree)
    refined = motion
    for _ in range(_STEPS):
        # Pairs of a moved point and a plane, and how far apart they are.
        moved = xyz @ refined[:, :3].T + refined[:, 3]
        moved, xy = points_in_image(moved, camera, measured.size)
        distance_px, index = tree.query(xy, distance_upper_bound=reach)
        near = np.isfinite(distance_px)
        near[near] &= flat[index[near]]
        moved, index = moved[near], index[near]
        if len(index) < _MIN_PLANES:
            return motion
        normal = normals[index]
        depth = surface[index, 2]
        distance = np.einsum("ij,ij->i", moved - surface[index], normal) / depth
        # A step of weighted least squares towards the planes.
        typical = max(_NORMAL_MEDIAN * float(np.median(np.abs(distance))), _LEAST_ERROR)
        weight = (1 + (distance / (2 * typical)) ** 2) ** -2
        slope = np.column_stack([np.cross(moved, normal), normal]) / depth[:, None]
        weighted = slope * weight[:, None]
        step = -np.linalg.lstsq(weighted.T @ slope, weighted.T @ distance, rcond=None)[0]
        refined = Rotation.from_rotvec(step[:3]).as_matrix() @ refined
        refined[:, 3] += step[3:]
    return refined


def keypoints_of(rgb: NDArray[np.float32]) -> Keypoints:
    """Returns the keypoints of an image (H, W, 3) in 0…1."""
    grey = cv2.cvtColor((rgb * 255).round().astype(np.uint8), cv2.COLOR_RGB2GRAY)
    # OpenCV's annotations lack SIFT
    keypoints, descriptors = cv2.SIFT_create(nfeatures=_KEYPOINTS).detectAndCompute(grey, None)  # type: ignore[attr-defined, unused-ignore]
    if descriptors is None:
        descriptors = np.empty((0, 128), np.float32)
    xy = np.array([keypoint.pt for keypoint in keypoints], np.float64).reshape(-1, 2)
    return xy, descriptors


def motion_of_images(
    here: Keypoints, there: Keypoints, points: Points, camera: Camera
) -> tuple[Floats | None, str]:
    """Returns the motion from the other frame's camera to this one's, from matched keypoints.

    The points are the sparse depth of the other frame; both have the same camera. The motion is
    (3, 4) in metres, and None if it is refused. The text says what supports it, or why it is.
    """
    # Keypoints of the other frame, which have its depth, and the rays on which this one sees them.
    xy_there, xy_here = _matches(here, there)
    depth, known = _depth_at(points, xy_there)
    xyz = unproject(camera, xy_there[known], depth[known])
    rays = rays_of(camera, xy_here[known])
    if len(xyz) < _MIN_INLIERS:
        return None, f"{len(xyz)} matches with depth, at least {_MIN_INLIERS} needed"
    # The motion with most matches; rays are pixels of a camera of focal length 1.
    solved, rotation, translation, index = cv2.solvePnPRansac(
        xyz,
        rays,
        np.eye(3),
        None,
        iterationsCount=_ITERATIONS,
        reprojectionError=_REPROJECTION_PX / float(camera.intrinsics[0, 0]),
        confidence=_CONFIDENCE,
        flags=cv2.SOLVEPNP_SQPNP,
    )
    inliers = np.empty(0, np.intp) if not solved or index is None else index.ravel()
    basis = f"{len(inliers)} of {len(xyz)} matches of the images"
    if len(inliers) < max(_MIN_INLIERS, _MIN_FRACTION * len(xyz)):
        return None, f"{basis} agree"
    # Refined with those that agree.
    rotation, translation = cv2.solvePnPRefineLM(
        xyz[inliers], rays[inliers], np.eye(3), None, rotation, translation
    )
    motion = np.column_stack([cv2.Rodrigues(rotation)[0], translation])
    # A frame that moved farther than what it sees shares no view with this one.
    length = float(np.linalg.norm(motion[:, 3]))
    median_depth = float(np.median(points.depth))
    if not length <= median_depth:
        return None, f"{length:.1f} m of motion at a median depth of {median_depth:.1f} m"
    return motion, basis


def _matches(here: Keypoints, there: Keypoints) -> tuple[Floats, Floats]:
    """(M, 2) keypoints of the other image, and (M, 2) their partners in this one."""
    xy_here, descriptors_here = here
    xy_there, descriptors_there = there
    if min(len(xy_here), len(xy_there)) < 2:
        return np.empty((0, 2)), np.empty((0, 2))
    pairs = cv2.BFMatcher(cv2.NORM_L2).knnMatch(descriptors_there, descriptors_here, k=2)
    clear = [best for best, second in pairs if best.distance < _RATIO * second.distance]
    matched_there = xy_there[[match.queryIdx for match in clear]]
    matched_here = xy_here[[match.trainIdx for match in clear]]
    return matched_there, matched_here


def _depth_at(points: Points, xy: Floats) -> tuple[Floats, Mask]:
    """Depth (M,) at pixels, a mean of the inverses of points around, and where it is known."""
    if len(points) < _MIN_INLIERS or not len(xy):
        return np.zeros(len(xy)), np.zeros(len(xy), bool)
    distance, near = cKDTree(points.xy).query(xy, k=4)
    around = points.depth[near].astype(np.float64)
    smooth = around.max(axis=1) < _JUMP * around.min(axis=1)
    weights = 1 / np.maximum(distance, _LEAST_DISTANCE_PX)
    depth = weights.sum(axis=1) / (weights / around).sum(axis=1)
    return depth, smooth & (distance[:, 0] < _REACH * _spacing_px(points))
