"""`mcap`: results as a bag of ROS 2, which ROS 2, Foxglove and Rerun open.

The folder is one that `ros2 bag play` takes: results.mcap and metadata.yaml. Depth is 32FC1 in
metres, NaN where it is unknown or not valid (REP 118). Camera axes are x right, y down, z forward
(the optical frame of REP 103). Each pose is a transform from `world` to the camera.

A frame's stamp is the time in its name, as `pnpdepth frames` and TUM's data sets have it.
"""

from __future__ import annotations

import re
import secrets
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from decimal import Decimal
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from pnpdepth_cli.camera import Camera
from pnpdepth_cli.commands.exports import Export, ExportFrame
from pnpdepth_cli.dataset.arrays import image_of_size
from pnpdepth_cli.dataset.frame_files import FrameFiles, ReadOptions, ScanOptions
from pnpdepth_cli.dataset.read_frame import read_frame
from pnpdepth_cli.errors import InputError, PnpDepthError
from pnpdepth_cli.file_record import FileRecord
from pnpdepth_cli.io.bags.writing import OutgoingMessage, write_mcap
from pnpdepth_cli.sensors.lens import unproject
from pnpdepth_cli.sensors.point_cloud import cloud_from_depth

_BAG = "results"
"""Name of the bag's file without its ending."""
_WORLD = "world"
"""frame_id of the poses' coordinates."""
_CAMERA = "camera"
"""frame_id of the camera's coordinates."""
_STEP_NS = 100_000_000
"""Time between frames whose names hold no time."""
_TIME = re.compile(r"(?:^|[^\d._])(\d{1,10})[._](\d{6,9})$")
"""End of a name that is a time in seconds, with six digits or more behind the point."""
_LENSES = {
    "radial-tangential": (("plumb_bob", 5), ("rational_polynomial", 8)),
    "fisheye": (("equidistant", 4),),
}
"""ROS' models of each lens, and how many coefficients they have."""
_FLOAT32 = 7
"""Number of the type float32 in sensor_msgs/PointField."""
_SAME = 1e-6
"""Relative difference up to which depths in metres count as the same; float32 has 1e-7."""

_Fields = dict[str, Any]
"""Fields of a ROS message by name, without its header."""


def _files(folder: Path, frames: Sequence[ExportFrame]) -> list[Path]:
    """The bag and its metadata, whatever the frames are."""
    return [folder / f"{_BAG}.mcap", folder / "metadata.yaml"]


def _write(folder: Path, frames: Sequence[ExportFrame], done: Callable[[], None]) -> list[str]:
    """Writes the bag, its frames in the order of their times; returns lines for a person.

    Args:
        folder: Output folder, which is there.
        frames: The frames.
        done: Callback after each frame.

    Raises:
        PnpDepthError: An image is damaged, ROS has no model of a lens, or rosbags is not there.
    """
    times_ns, notes = _times(frames)

    def outgoing() -> Iterator[OutgoingMessage]:
        """Yields the messages of all frames; a frame is read when its turn comes."""
        for place in np.argsort(times_ns, kind="stable"):
            yield from _messages(frames[place], times_ns[place], notes)
            done()

    # rosbags makes the folder itself, so it is made beside the files and emptied.
    temporary = folder / f".{secrets.token_hex(6)}"
    try:
        write_mcap(temporary / _BAG, outgoing())
        for path in _files(folder, frames):
            (temporary / _BAG / path.name).replace(path)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
    return notes


def _times(frames: Sequence[ExportFrame]) -> tuple[list[int], list[str]]:
    """Nanoseconds of each frame, as its name says; and notes.

    Where a name holds no time, all frames have made-up times at equal distances, and a note says
    so.
    """
    matches = [_TIME.search(frame.result.name) for frame in frames]
    # Decimal, as a float of seconds since 1970 is exact to 240 ns only.
    times_ns = [int(Decimal(f"{match[1]}.{match[2]}").scaleb(9)) for match in matches if match]
    if len(times_ns) == len(frames):
        return times_ns, []
    note = f"stamps: the names of the frames hold no times; {1e-9 * _STEP_NS:g} s apart"
    return [_STEP_NS * number for number in range(1, len(frames) + 1)], [note]


def _messages(frame: ExportFrame, time_ns: int, notes: list[str]) -> Iterator[OutgoingMessage]:
    """Yields the messages of a frame.

    Args:
        frame: The frame.
        time_ns: Stamp of all its messages, nanoseconds.
        notes: Lines for a person; gets one on what is left out.

    Raises:
        InputError: ROS has no model of the camera's lens.
    """
    seconds, nanoseconds = divmod(time_ns, 10**9)
    header = {"stamp": {"sec": seconds, "nanosec": nanoseconds}, "frame_id": _CAMERA}

    def message(topic: str, kind: str, fields: Mapping[str, Any]) -> OutgoingMessage:
        """The message of a topic: fields of a ROS type `kind`, with the header of the frame."""
        return OutgoingMessage(topic, kind, time_ns, {"header": header, **fields})

    # The pose comes first, so that viewers can place what follows.
    if frame.pose is not None:
        transform = {"header": header | {"frame_id": _WORLD}, **_transform(frame.pose)}
        kind = "tf2_msgs/msg/TFMessage"
        yield OutgoingMessage("/tf", kind, time_ns, {"transforms": [transform]})
    # The image, and the camera of both it and the depth.
    rgb = image_of_size(frame.image, frame.size)
    camera_info = _camera_info(frame.camera, frame.size)
    pixels = np.rint(255 * rgb).astype(np.uint8)
    yield message("/camera/camera_info", "sensor_msgs/msg/CameraInfo", camera_info)
    yield message("/camera/image", "sensor_msgs/msg/Image", _image(pixels, "rgb8"))
    # Depth and its standard deviation.
    depth = frame.valid_depth()
    nan_where_unknown = np.where(depth > 0, depth, np.float32(np.nan))
    depth_image = _image(nan_where_unknown, "32FC1")
    yield message("/camera/depth/camera_info", "sensor_msgs/msg/CameraInfo", camera_info)
    yield message("/camera/depth/image", "sensor_msgs/msg/Image", depth_image)
    if frame.result.sigma is not None:
        sigma = frame.result.read_beside(frame.result.sigma, depth).astype(np.float32)
        yield message("/camera/depth/sigma", "sensor_msgs/msg/Image", _image(sigma, "32FC1"))
    # The points that were used, and the cloud of the depth, in the camera's coordinates.
    points = _points_used(frame, notes)
    if points is not None:
        yield message("/camera/points_used", "sensor_msgs/msg/PointCloud2", _cloud(points))
    clouds = list(cloud_from_depth(depth, frame.camera, rgb))
    xyz = np.concatenate([cloud.xyz for cloud in clouds])
    colours = np.concatenate([cloud.rgb for cloud in clouds if cloud.rgb is not None])
    yield message("/camera/cloud", "sensor_msgs/msg/PointCloud2", _cloud(xyz, colours))


def _transform(pose: NDArray[np.float64]) -> _Fields:
    """The fields of a TransformStamped from the world to the camera, of the camera's (3, 4) pose.

    ROS means by it what the pose is: where the camera's coordinates lie in the world's.
    """
    x, y, z, w = Rotation.from_matrix(pose[:, :3]).as_quat().tolist()
    translation = dict(zip("xyz", pose[:, 3].tolist(), strict=True))
    rotation = {"x": x, "y": y, "z": z, "w": w}
    return {
        "child_frame_id": _CAMERA,
        "transform": {"translation": translation, "rotation": rotation},
    }


def _camera_info(camera: Camera, size: tuple[int, int]) -> _Fields:
    """The fields of a CameraInfo of images that are not rectified.

    Args:
        camera: The camera in pixels of the images.
        size: (H, W) of the images.

    Raises:
        InputError: ROS has no model of the lens with so many coefficients.
    """
    # Zeros at the end of the coefficients say nothing, and may be cut or added.
    coefficients = [*camera.distortion]
    while coefficients and not coefficients[-1]:
        coefficients.pop()
    models = _LENSES.get(camera.lens, ())
    model = next(((name, count) for name, count in models if len(coefficients) <= count), None)
    if model is None:
        raise InputError(
            f"ROS knows no lens {camera.lens} with {len(coefficients)} coefficients; refine"
            " undistorted images"
        )
    name, count = model
    zeros = [0.0] * (count - len(coefficients))
    projection = np.column_stack([camera.intrinsics, np.zeros(3)])
    return {
        "height": size[0],
        "width": size[1],
        "distortion_model": name,
        "d": np.array([*coefficients, *zeros]),
        "k": camera.intrinsics.ravel(),
        "r": np.eye(3).ravel(),  # no rectification
        "p": projection.ravel(),
    }


def _image(pixels: NDArray[Any], encoding: str) -> _Fields:
    """The fields of an Image, little-endian, rows without padding.

    Args:
        pixels: (H, W) or (H, W, C), of the type that the encoding has.
        encoding: ROS' name of the type of a pixel, such as `rgb8`.
    """
    # (H, bytes of a row)
    rows = np.ascontiguousarray(pixels.reshape(len(pixels), -1))
    data = rows.astype(rows.dtype.newbyteorder("<"), copy=False).view(np.uint8)
    return {
        "encoding": encoding,
        "height": pixels.shape[0],
        "width": pixels.shape[1],
        "step": data.shape[1],
        "data": data.ravel(),
    }


def _cloud(xyz: NDArray[np.floating], rgb: NDArray[np.uint8] | None = None) -> _Fields:
    """The fields of a PointCloud2 with x y z, and a packed colour 0x00RRGGBB where it is given.

    Args:
        xyz: (N, 3) in the camera's coordinates.
        rgb: (N, 3) colours.
    """
    kinds = [("x", "<f4"), ("y", "<f4"), ("z", "<f4")]
    if rgb is not None:
        kinds.append(("rgb", "<u4"))
    points = np.zeros(len(xyz), np.dtype(kinds))
    for column, name in enumerate("xyz"):
        points[name] = xyz[:, column]
    if rgb is not None:
        red, green, blue = rgb.astype(np.uint32).T
        points["rgb"] = red << 16 | green << 8 | blue
    fields = [
        # RViz and PCL expect colours to be named as floats
        {"name": name, "offset": 4 * place, "datatype": _FLOAT32, "count": 1}
        for place, (name, _) in enumerate(kinds)
    ]
    data = np.frombuffer(points.tobytes(), np.uint8)
    return {
        "height": 1,
        "width": len(points),
        "fields": fields,
        "point_step": points.dtype.itemsize,
        "row_step": data.size,
        "data": data,
        "is_dense": True,
    }


def _files_of_points(frame: ExportFrame, sparse: FileRecord) -> FrameFiles:
    """The files of a frame from which its points were read.

    Args:
        frame: The frame.
        sparse: What its record says of the file of its sparse depth.
    """
    source = Path(sparse.path)
    is_sampled = sparse.kind == "sampled"  # from ground truth, which is then the file
    return FrameFiles(
        name=frame.result.name,
        image=frame.image,
        sparse=None if is_sampled else source,
        gt=source if is_sampled else None,
        sparse_scale=sparse.scale,
        gt_scale=sparse.scale,
        sparse_mask=None if sparse.mask is None else Path(sparse.mask),
        min_confidence=sparse.least,
        one_view=True,
    )


def _options_of_points(sparse: FileRecord) -> ReadOptions:
    """The options by which the points of a frame were read.

    Args:
        sparse: What the frame's record says of the file of its sparse depth.
    """
    scan = ScanOptions(
        calib=None if sparse.calibration is None else Path(sparse.calibration),
        extrinsics=None if sparse.extrinsics is None else Path(sparse.extrinsics),
        camera=sparse.camera,
        keep_occluded=sparse.keep_occluded,
    )
    return ReadOptions(
        unit_scale=sparse.unit_scale,
        registration="off",  # it moves the image, not the points
        scan=scan,
        sample=sparse.sampled,
    )


def _points_used(frame: ExportFrame, notes: list[str]) -> NDArray[np.float32] | None:
    """(N, 3) the frame's own points that were used, in the camera's coordinates.

    They are read again as the frame's record says. None without a record; None, with a note, where
    their files are gone or give other points than then.

    Args:
        frame: The frame.
        notes: Lines for a person; gets one on points that are left out.
    """
    sparse = frame.result.record.inputs.get("sparse")
    result = frame.result.record.result
    if sparse is None or result is None:
        return None
    # The files are read as the record says.
    seed = result.settings.get("seed") or 0
    holdout = result.settings.get("holdout") or 0.0
    try:
        frame_now = read_frame(
            _files_of_points(frame, sparse),
            _options_of_points(sparse),
            seed=int(seed),
            holdout=float(holdout),
        )
    # PnpDepthError: a file is gone or damaged. ValueError: a setting in the record is no number.
    except (PnpDepthError, ValueError) as error:
        notes.append(f"warning: {frame.result.name}: its points are left out: {error}")
        return None
    # They must be the points of the record: as many, from the same nearest to the same farthest.
    points = frame_now.points
    ends = (float(frame_now.own_points.depth.min()), float(frame_now.own_points.depth.max()))
    recorded = result.points
    wanted = recorded.used - (recorded.moved or 0)  # without those of neighbouring frames
    wanted_ends = (recorded.nearest, recorded.farthest)
    if len(points) != wanted or not np.allclose(ends, wanted_ends, rtol=_SAME):
        notes.append(
            f"warning: {frame.result.name}: its points are left out, as {sparse.path} gives others"
            f" now: {len(points):,} from {ends[0]:g} to {ends[1]:g}, not {wanted:,} from"
            f" {wanted_ends[0]:g} to {wanted_ends[1]:g}"
        )
        return None
    xyz = unproject(frame.camera, points.xy.numpy().astype(np.float64), points.depth.numpy())
    return xyz.astype(np.float32)


EXPORT = Export(needs_pose=False, files=_files, write=_write, in_model_units=False)
