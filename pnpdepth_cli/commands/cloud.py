"""`pnpdepth cloud`: depth maps as one coloured point cloud."""

from __future__ import annotations

import functools
from collections import deque
from collections.abc import Callable, Iterable, Iterator

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.camera import SAME_PLACE, Camera, Extrinsics
from pnpdepth_cli.commands.requests import check_outputs
from pnpdepth_cli.commands.requests.cloud_request import CloudRequest
from pnpdepth_cli.commands.shared.results import ResultFrame, result_frames
from pnpdepth_cli.dataset.arrays import camera_of_exif, camera_of_file, image_of_size
from pnpdepth_cli.dataset.frame_record import Pose
from pnpdepth_cli.dataset.range_ends import far_values
from pnpdepth_cli.errors import InputError, UsageError
from pnpdepth_cli.io.atomic import make_folder
from pnpdepth_cli.io.poses import poses_of_frames
from pnpdepth_cli.io.scans import write_cloud
from pnpdepth_cli.sensors import point_cloud
from pnpdepth_cli.sensors.point_cloud import PointCloud

_IN_MEMORY = 12
"""Depth maps of neighbouring views that are kept, with their points."""


def write_depth_cloud(
    request: CloudRequest, show: Callable[[int, int], None] = lambda done, of: None
) -> tuple[str, list[str]]:
    """Writes the cloud of the depth files; returns what is in it in words, and lines for a person.

    Args:
        request: Depth files, camera, poses and limits of the cloud.
        show: Receives the numbers of frames that are in the cloud, and of all.

    Raises:
        PnpDepthError: An input or output is at fault; then nothing is written.
    """
    # The frames. Either all have a pose or none; views can only agree if they have.
    check_outputs([request.output], overwrite=request.overwrite)
    frames = result_frames(request.depth)
    notes: list[str] = []
    poses = _poses(request, frames, notes)
    if request.min_views > 1 and (poses[0] is None or len(frames) < request.min_views):
        raise UsageError(
            f"--min-views {request.min_views} needs as many frames with poses; give a folder of"
            " results, and --poses"
        )
    # The cloud, part by part.
    is_coloured = all(request.image or frame.image for frame in frames)
    # Without poses, every camera lies at the world's origin.
    known_poses = [np.eye(3, 4) if pose is None else pose for pose in poses]
    clouds: Iterable[PointCloud] = _clouds(
        request, frames, known_poses, is_coloured=is_coloured, notes=notes, show=show
    )
    make_folder(request.output.parent)
    if request.voxel is not None:
        clouds = [point_cloud.merge_in_voxels(clouds, request.voxel)]
    points = write_cloud(request.output, clouds)
    # Why it has no colours: the first frame without an image says it.
    lost = next((frame.lost_image for frame in frames if not frame.image), "")
    colours = "coloured" if is_coloured else f"without colours ({lost})"
    return f"{points:,} points, {colours}", notes


def _poses(request: CloudRequest, frames: list[ResultFrame], notes: list[str]) -> list[Pose | None]:
    """The pose of each frame: of the file that is given, else of the records, else estimated.

    None for all frames where nothing tells them.

    Args:
        request: What is asked of the cloud.
        frames: The frames.
        notes: Lines for a person; gets where the poses are from, or that there are none.

    Raises:
        InputError: The file does not fit the frames, or only some records have a pose.
    """
    if request.poses is not None:
        names = [frame.name for frame in frames]
        poses_of_file, how = poses_of_frames(request.poses, names, request.pose_kind)
        notes.append(f"poses: {request.poses}, {how}")
        return list(poses_of_file)
    poses = [frame.camera_and_pose[1] for frame in frames]
    if len(frames) > 1 and all(pose is None for pose in poses):
        poses = _estimated_poses(frames, notes)
    without = [frame.depth for frame, pose in zip(frames, poses, strict=True) if pose is None]
    if without and len(without) < len(frames):
        raise InputError(
            f"{without[0]} has no pose in its record, but others have; give --poses for all, or"
            " refine it again as the others"
        )
    if len(without) > 1:
        notes.append(
            f"warning: {len(without):,} frames without poses: their points lie on each other; give"
            " --poses"
        )
    return poses


def _estimated_poses(frames: list[ResultFrame], notes: list[str]) -> list[Pose | None]:
    """The poses that follow from the motions that `batch --accumulate` estimated.

    The first frame's camera is the world. None for all frames unless motions tie all together.

    Args:
        frames: The frames, whose records have motions to their neighbours.
        notes: Lines for a person; gets where the poses are from.

    Raises:
        InputError: A record is damaged.
    """
    # For each frame the frames that a motion ties to it, each with the motion that leads from the
    # other's coordinates to its own; both directions of each motion. A record names its neighbours
    # by the file of their points.
    place = {_points_file(frame): index for index, frame in enumerate(frames)}
    ties: list[list[tuple[int, Extrinsics]]] = [[] for _ in frames]
    for here, frame in enumerate(frames):
        result = frame.record.result
        neighbours = [] if result is None else result.neighbours
        for neighbour in neighbours:
            there = place.get(neighbour.path)
            if there is None or neighbour.motion is None:
                continue
            matrix = np.array(neighbour.motion, np.float64)
            if matrix.shape != (3, 4):
                raise InputError(f"{frame.depth}: the record beside it is damaged; refine it again")
            motion = Extrinsics(matrix[:, :3], matrix[:, 3])
            ties[here].append((there, motion))
            ties[there].append((here, motion.inverse()))
    # The poses of the frames that are tied to the first, by their index; those with the fewest
    # motions between come first.
    poses = {0: SAME_PLACE}
    waiting = deque([0])
    while waiting:
        here = waiting.popleft()
        for there, motion in ties[here]:
            if there not in poses:
                poses[there] = poses[here] @ motion
                waiting.append(there)
    if len(poses) < len(frames):
        return [None] * len(frames)
    notes.append("poses: the motions that `batch --accumulate` estimated, one after the other")
    return [poses[index].square()[:3] for index in range(len(frames))]  # (3, 4) each


def _points_file(frame: ResultFrame) -> str:
    """The file that the frame's points are from, as records of its neighbours name it.

    It is the frame's name where its record has no such file.
    """
    source = frame.record.inputs.get("sparse")
    return frame.name if source is None else source.path


def _clouds(
    request: CloudRequest,
    frames: list[ResultFrame],
    poses: list[Pose],
    *,
    is_coloured: bool,
    notes: list[str],
    show: Callable[[int, int], None],
) -> Iterator[PointCloud]:
    """Yields the points of all depth maps in the world's coordinates, some rows at a time.

    Args:
        request: What is asked of the cloud.
        frames: The depth maps.
        poses: Pose of each.
        is_coloured: Whether the points get the colours of the images.
        notes: Lines for a person; gets those on cameras and depth.
        show: Receives the numbers of frames that are done, and of all.

    Raises:
        InputError: A file is damaged or lacks what is asked for, or there is no point.
    """

    # A depth map is read once, though several views around it need it.
    @functools.lru_cache(maxsize=_IN_MEMORY)
    def depth_and_camera(index: int) -> tuple[NDArray[np.float32], Camera]:
        """The depth (H, W) of the frame of this index, 0 where it is not used, and its camera."""
        depth = _depth(request, frames[index], notes)
        camera, camera_notes = _camera(request, frames[index], (depth.shape[0], depth.shape[1]))
        notes.extend(note for note in camera_notes if note not in notes)
        return depth, camera

    @functools.lru_cache(maxsize=_IN_MEMORY)
    def view(index: int) -> point_cloud.View:
        """The frame of this index as (H, W, 3) points in its camera's coordinates, camera, pose."""
        depth, camera = depth_and_camera(index)
        return point_cloud.points_of_depth(depth, camera).astype(np.float32), camera, poses[index]

    # Pixels on which enough views agree, as coloured points.
    is_empty = True
    for index, frame in enumerate(frames):
        show(index, len(frames))
        depth, camera = depth_and_camera(index)
        if request.min_views > 1:
            near = point_cloud.neighbouring_views(np.stack(poses), index)
            depth = point_cloud.consistent_depth(view(index), map(view, near), request.min_views)
        image = request.image or frame.image
        rgb = image_of_size(image, depth.shape) if is_coloured and image is not None else None
        for cloud in point_cloud.cloud_from_depth(depth, camera, rgb):
            is_empty &= not len(cloud.xyz)
            yield cloud.transform(poses[index])
    if is_empty:
        raise InputError(f"{request.depth}: no pixel is left; relax --max-depth, --max-sigma, …")


def _depth(request: CloudRequest, frame: ResultFrame, notes: list[str]) -> NDArray[np.float32]:
    """The depth of a frame (H, W), 0 where it is unknown, not valid, or excluded by the request.

    Args:
        request: What is asked of the cloud.
        frame: The frame.
        notes: Lines for a person; gets those on values that are no depth.

    Raises:
        InputError: A file is damaged, or no standard deviation is there and one is needed.
    """
    depth, keep = frame.read(request.depth_scale)
    # Extreme values are no depth, such as the one that all pixels of the sky have.
    is_no_depth, lines = far_values(depth[keep], frame.record.unit)
    keep[keep] = ~is_no_depth
    notes.extend(f"{frame.depth}: {line}" for line in lines)
    # The user's limits.
    keep &= depth <= request.max_depth
    if request.max_sigma is not None:
        if frame.sigma is None:
            raise InputError(
                f"{frame.depth} has no standard deviation beside it; --max-sigma needs the file"
                " that `pnpdepth refine --uncertainty` writes"
            )
        keep &= frame.read_beside(frame.sigma, depth) <= request.max_sigma * depth
    return np.where(keep, depth, np.float32(0))


def _camera(
    request: CloudRequest, frame: ResultFrame, size: tuple[int, int]
) -> tuple[Camera, list[str]]:
    """The camera that is given, else of the record, else of EXIF; and lines for a person.

    Args:
        request: What is asked of the cloud.
        frame: The frame.
        size: (H, W) of its depth.

    Raises:
        InputError: There is no camera, or it is of another size.
    """
    if request.calib is not None:
        return camera_of_file(request.calib, None, size, frame.depth)
    camera, _ = frame.camera_and_pose
    if camera is not None:
        if frame.size != size:
            raise InputError(
                f"{frame.depth} is {size[1]}×{size[0]}, unlike its record; refine it again, or give"
                " --calib"
            )
        return camera, [f"camera: {camera.source} (from the record)"]
    lacking = f"{frame.depth} has no camera in a record"
    return camera_of_exif(request.image or frame.image, size, lacking)
