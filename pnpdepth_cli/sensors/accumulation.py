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

# Which moved points agree with the measured ones around them (a "moved" point is another scan's).
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
_AGREEING = 2  # of these must agree, where the nearest one does not
_CONTRADICTING = 12  # nearest measured points, of which none may contradict

# The registration of a scan to the planes of the frame's own.
_MIN_PLANES = 200  # pairs of a point and a plane; with fewer the motion is not corrected
_STEPS = 8  # of the correction
_NEIGHBOURS = 8  # points that a plane is fitted to,
_NEAR = 0.1  # whose depth differs by this fraction at most,
_FLAT = 0.02  # and whose smallest variance, along the normal, is below this fraction of the next
_REACH = 1.2  # mean spacings of the points, between a point and the one it is compared with
_LEAST_ERROR = 2e-4  # least typical distance of points from their planes, fraction of the depth
_STD_OF_MEDIAN = 1.4826  # standard deviation of normal errors over the median of their size

# The motion of images, estimated where no pose is known.
_MIN_INLIERS = 30  # matches that agree with it; fewer support none
_MIN_FRACTION = 0.25  # of the matches that agree with it
_KEYPOINTS = 3000  # of an image, at most
_RATIO = 0.8  # of the distances to the nearest and the next descriptor, as Lowe has it
_ITERATIONS = 1000  # of RANSAC
_CONFIDENCE = 0.9999  # that RANSAC tried a set of inliers
_REPROJECTION_PX = 2.0  # distance of a match that agrees, at most
_JUMP = 1.1  # ratio of depths of the points around a keypoint, from which on it has none
_AROUND = 4  # points that a keypoint has its depth from
_LEAST_DISTANCE_PX = 1e-3  # between a keypoint and a point, so that its weight is finite


Scan = tuple[Points, Floats]
"""The points of another frame in pixels of its image, and its motion (3, 4) in metres.

The motion leads from coordinates of the other frame's camera to those of this frame's: x_here =
motion[:, :3] · x_there + motion[:, 3]."""
Keypoints = tuple[Floats, NDArray[np.float32]]
"""(K, 2) pixel coordinates and (K, 128) descriptors of SIFT."""


def _spacing_px(points: Points) -> float:
    """The mean spacing of points in pixels: the side of the square that each has to itself."""
    return float(np.sqrt(points.size[0] * points.size[1] / len(points)))


def accumulate(points: Points, neighbours: Mapping[int, Sequence[Scan]], camera: Camera) -> Points:
    """Returns a frame's own points followed by those of neighbouring frames that agree with them.

    A point of a frame that is `apart` frames away joins if no point that is there already is nearer
    than `apart` pixels: the farther a frame is away in time, the larger the gaps that it fills.

    Args:
        points: The frame's own points, depth in metres.
        neighbours: Scans of other frames, each with its motion to this frame's camera, by how many
            frames they are before or after this one, from 1 on.
        camera: The camera of all frames.
    """
    joined = points
    for apart, scans in sorted(neighbours.items()):  # the nearest in time first
        # The points of these neighbours in this frame's camera, their motions corrected.
        moved = []
        for neighbour, motion in scans:
            xyz = unproject(camera, neighbour.xy, neighbour.depth)
            refined = refine_motion(points, xyz, motion, camera)
            moved.append(xyz @ refined[:, :3].T + refined[:, 3])
        # Those join that agree with this frame's own points and lie in a gap of the points so far.
        xyz, xy = points_in_image(np.concatenate(moved), camera, points.size)
        agrees = _agrees(xy, xyz[:, 2], points)
        xy = xy[agrees]
        depth = xyz[agrees, 2]
        distance_px, _ = cKDTree(joined.xy).query(xy)
        is_free = distance_px >= apart
        joined = replace(
            joined,
            xy=np.concatenate([joined.xy, xy[is_free].astype(np.float32)]),
            depth=np.concatenate([joined.depth, depth[is_free].astype(np.float32)]),
        )
    return joined


def _agrees(xy: Floats, depth: Floats, measured: Points) -> Mask:
    """(M,) true where a moved point agrees with the measured points around it.

    Args:
        xy: (M, 2) pixel coordinates of the moved points.
        depth: (M,) their depths, metres.
        measured: The frame's own points.
    """
    nearest = _nearest(cKDTree(measured.xy), xy, _CONTRADICTING)
    difference = np.abs(np.log(depth[:, None] / measured.depth[nearest]))
    # The nearest measured point agrees with it, or several of the nearest do.
    is_alike = difference[:, :_COMPARED] <= _TOLERANCE
    is_supported = is_alike[:, 0] | (is_alike.sum(axis=1) >= _AGREEING)
    # None that is close in the image, across and down, has quite another depth.
    offset = np.abs(measured.xy[nearest] - xy[:, None]) / _spacing_px(measured)  # (M, K, 2)
    is_close = (offset <= _CLOSE).all(axis=2)
    is_contradicted = (is_close & (difference > _CONTRADICTION)).any(axis=1)
    agrees: Mask = is_supported & ~is_contradicted
    return agrees


def _nearest(tree: cKDTree, xy: NDArray[np.floating], count: int) -> NDArray[np.intp]:
    """(M, K) numbers of the points nearest to each of M pixels, the nearest first.

    K is `count`, or the number of points if there are fewer. There may be no pixels, as of a
    neighbour that sees nothing of the frame's view.

    Args:
        tree: Tree of the points' pixel coordinates.
        xy: (M, 2) pixel coordinates.
        count: Number of points that are wanted.
    """
    ranks = np.arange(1, min(count, tree.n) + 1)  # a list of ranks gives a row for each pixel
    _, numbers = tree.query(xy, k=ranks)
    return np.asarray(numbers, np.intp)


def _planes(points: Points, xyz: Floats, tree: cKDTree) -> tuple[Floats, Mask]:
    """Unit normals (N, 3) of the planes through the neighbours of each point, and which are flat.

    A normal's sign is either of the two. The mask (N,) is true where the neighbours lie in a plane.

    Args:
        points: N points.
        xyz: (N, 3) the same points in the camera's coordinates, metres.
        tree: Tree of their pixel coordinates.
    """
    neighbours = _nearest(tree, points.xy, _NEIGHBOURS)
    # The normal is the direction in which the neighbours vary least.
    around = xyz[neighbours] - xyz[neighbours].mean(axis=1, keepdims=True)
    scatter = np.einsum("nki,nkj->nij", around, around)  # (N, 3, 3), of the K neighbours
    variance, axes = np.linalg.eigh(scatter)  # rising variances, and their axes as columns
    jump = np.abs(np.log(points.depth[neighbours] / points.depth[:, None])).max(axis=1)
    is_flat = (variance[:, 0] < _FLAT * variance[:, 1]) & (jump < _NEAR)
    return axes[:, :, 0], is_flat


def refine_motion(measured: Points, xyz: Floats, motion: Floats, camera: Camera) -> Floats:
    """Returns the motion (3, 4) corrected so that another frame's points lie on measured surfaces.

    The motion is returned as it was given if too few points are near to a flat surface.

    Args:
        measured: The points of the frame, which measured the surfaces.
        xyz: (M, 3) points of the other frame in its camera's coordinates, metres.
        motion: (3, 4) from there to the camera of the frame, metres.
        camera: The camera of both frames.
    """
    # The planes of the measured points.
    reach_px = _REACH * _spacing_px(measured)
    tree = cKDTree(measured.xy)
    surface = unproject(camera, measured.xy, measured.depth)
    normals, is_flat = _planes(measured, surface, tree)
    refined = motion
    for _ in range(_STEPS):
        # Pairs of a moved point and the plane at the measured point nearest to it in the image, and
        # how far apart they are, as a fraction of the depth.
        moved = xyz @ refined[:, :3].T + refined[:, 3]
        moved, xy = points_in_image(moved, camera, measured.size)
        distance_px, index = tree.query(xy, distance_upper_bound=reach_px)
        is_paired = np.isfinite(distance_px)
        is_paired[is_paired] &= is_flat[index[is_paired]]
        moved, index = moved[is_paired], index[is_paired]
        if len(index) < _MIN_PLANES:
            return motion
        normal = normals[index]
        depth = surface[index, 2]
        distance = np.einsum("ij,ij->i", moved - surface[index], normal) / depth
        # A step of least squares towards the planes, with the weights of Geman and McClure, which
        # fall with the distance. `slope` (P, 6) is the derivative of the distance by a small
        # rotation vector and translation.
        typical = max(_STD_OF_MEDIAN * float(np.median(np.abs(distance))), _LEAST_ERROR)
        weight = (1 + (distance / (2 * typical)) ** 2) ** -2
        slope = np.column_stack([np.cross(moved, normal), normal]) / depth[:, None]
        weighted = slope * weight[:, None]
        step = -np.linalg.lstsq(weighted.T @ slope, weighted.T @ distance, rcond=None)[0]
        refined = Rotation.from_rotvec(step[:3]).as_matrix() @ refined
        refined[:, 3] += step[3:]
    return refined


def keypoints_of(rgb: NDArray[np.float32]) -> Keypoints:
    """Returns the SIFT keypoints of an image (H, W, 3) in 0…1; there may be none."""
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
    """Returns the motion from another frame's camera to this one's, from matched keypoints.

    Args:
        here: Keypoints of this frame's image.
        there: Keypoints of the other frame's image.
        points: Sparse depth of the other frame.
        camera: The camera of both frames.

    Returns:
        The motion (3, 4) in metres, None if it is refused; and a text that says what supports it,
        or why it is refused.
    """
    # Keypoints of the other frame, which have its depth, and the rays on which this one sees them.
    xy_there, xy_here = _matches(here, there)
    depth, is_known = _depth_at(points, xy_there)
    xyz = unproject(camera, xy_there[is_known], depth[is_known])
    rays = rays_of(camera, xy_here[is_known])
    if len(xyz) < _MIN_INLIERS:
        return None, f"{len(xyz)} matches with depth, at least {_MIN_INLIERS} needed"
    # The motion that most matches agree with. Rays are pixels of a camera whose matrix is the
    # identity, so the error is divided by the focal length.
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
    inliers = index.ravel() if solved and index is not None else np.empty(0, np.intp)
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
    """(M, 2) pixel coordinates of keypoints of the other image, and (M, 2) of their partners here.

    A keypoint is matched if its descriptor's nearest one here is clearly nearer than the next.

    Args:
        here: Keypoints of this frame's image.
        there: Keypoints of the other frame's image.
    """
    xy_here, descriptors_here = here
    xy_there, descriptors_there = there
    if min(len(xy_here), len(xy_there)) < 2:  # no second nearest one to compare with
        return np.empty((0, 2)), np.empty((0, 2))
    pairs = cv2.BFMatcher(cv2.NORM_L2).knnMatch(descriptors_there, descriptors_here, k=2)
    clear = [best for best, second in pairs if best.distance < _RATIO * second.distance]
    matched_there = xy_there[[match.queryIdx for match in clear]]
    matched_here = xy_here[[match.trainIdx for match in clear]]
    return matched_there, matched_here


def _depth_at(points: Points, xy: Floats) -> tuple[Floats, Mask]:
    """Depth (M,) in metres at pixels (M, 2), and (M,) true where it is known.

    It is known where the nearest points are on one surface, and one of them is near. Depth is the
    inverse of their mean inverse depth, weighted by the inverse of their distance in the image.

    Args:
        points: The points.
        xy: (M, 2) pixel coordinates.
    """
    if len(points) < _MIN_INLIERS or not len(xy):  # too few for a motion, or nothing is asked for
        return np.zeros(len(xy)), np.zeros(len(xy), bool)
    distance_px, numbers = cKDTree(points.xy).query(xy, k=_AROUND)
    around = points.depth[numbers].astype(np.float64)
    is_smooth = around.max(axis=1) < _JUMP * around.min(axis=1)
    is_near = distance_px[:, 0] < _REACH * _spacing_px(points)
    weights = 1 / np.maximum(distance_px, _LEAST_DISTANCE_PX)
    depth = weights.sum(axis=1) / (weights / around).sum(axis=1)
    return depth, is_smooth & is_near
