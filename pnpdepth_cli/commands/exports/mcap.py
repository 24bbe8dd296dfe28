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
_WORLD = "world"
_CAMERA = "camera"
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
"""Of sensor_msgs/PointField."""

_Fields = dict[str, Any]


def _files(folder: Path, frames: Sequence[ExportFrame]) -> list[Path]:
    return [folder / f"{_BAG}.mcap", folder / "metadata.yaml"]


def _write(folder: Path, frames: Sequence[ExportFrame], done: Callable[[], None]) -> list[str]:
    times_ns, notes = _times(frames)

    def outgoing() -> Iterator[OutgoingMessage]:
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
    """Nanoseconds of each frame, and a note where they are not those of the names."""
    found = [_TIME.search(frame.result.name) for frame in frames]
    times_ns = [int(Decimal(f"{time[1]}.{time[2]}").scaleb(9)) for time in found if time]
    if len(times_ns) == len(frames):
        return times_ns, []
    note = f"stamps: the names of the frames hold no times; {1e-9 * _STEP_NS:g} s apart"
    return [_STEP_NS * number for number in range(1, len(frames) + 1)], [note]


def _messages(frame: ExportFrame, time_ns: int, notes: list[str]) -> Iterator[OutgoingMessage]:
    """Yields the messages of a frame; what is left out is told in `notes`."""
    seconds, nanoseconds = divmod(time_ns, 10**9)
    header = {"stamp": {"sec": seconds, "nanosec": nanoseconds}, "frame_id": _CAMERA}

    def message(topic: str, kind: str, fields: Mapping[str, Any]) -> OutgoingMessage:
        return OutgoingMessage(topic, kind, time_ns, {"header": header, **fields})

    # The pose comes first, so that viewers can place what follows.
    if frame.pose is not None:
        transform = {"header": header | {"frame_id": _WORLD}, **_transform(frame.pose)}
        kind = "tf2_msgs/msg/TFMessage"
        yield OutgoingMessage("/tf", kind, time_ns, {"transforms": [transform]})
    # The image, and the camera of both it and the depth.
    rgb = image_of_size(frame.image, frame.size)
    info = _camera_info(frame.camera, frame.size)
    pixels = np.rint(255 * rgb).astype(np.uint8)
    yield message("/camera/camera_info", "sensor_msgs/msg/CameraInfo", info)
    yield message("/camera/image", "sensor_msgs/msg/Image", _image(pixels, "rgb8"))
    # Depth and its standard deviation.
    depth = frame.valid_depth()
    unknown = np.where(depth > 0, depth, np.float32(np.nan))
    yield message("/camera/depth/camera_info", "sensor_msgs/msg/CameraInfo", info)
    yield message("/camera/depth/image", "sensor_msgs/msg/Image", _image(unknown, "32FC1"))
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
    x, y, z, w = Rotation.from_matrix(pose[:, :3]).as_quat().tolist()
    shift = dict(zip("xyz", pose[:, 3].tolist(), strict=True))
    turn = {"x": x, "y": y, "z": z, "w": w}
    return {"child_frame_id": _CAMERA, "transform": {"translation": shift, "rotation": turn}}


def _camera_info(camera: Camera, size: tuple[int, int]) -> _Fields:
    """The fields of a CameraInfo of images that are not rectified. InputError for other lenses."""
    given = [*camera.distortion]
    while given and not given[-1]:
        given.pop()
    models = _LENSES.get(camera.lens, ())
    model = next(((name, count) for name, count in models if len(given) <= count), None)
    if model is None:
        raise InputError(
            f"ROS knows no lens {camera.lens} with {len(given)} coefficients; refine undistorted"
            " images"
        )
    name, count = model
    projection = np.column_stack([camera.intrinsics, np.zeros(3)])
    return {
        "height": size[0],
        "width": size[1],
        "distortion_model": name,
        "d": np.array([*given, *[0.0] * (count - len(given))]),
        "k": camera.intrinsics.ravel(),
        "r": np.eye(3).ravel(),
        "p": projection.ravel(),
    }


def _image(pixels: NDArray[Any], encoding: str) -> _Fields:
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
    """The fields of a PointCloud2 with x y z, and a packed colour 0x00RRGGBB where it is given."""
    names = [*"xyz"] if rgb is None else [*"xyz", "rgb"]
    kinds = [np.dtype("<f4")] * 3 + [np.dtype("<u4")] * (len(names) - 3)
    points = np.zeros(len(xyz), np.dtype(list(zip(names, kinds, strict=True))))
    for column, name in enumerate("xyz"):
        points[name] = xyz[:, column]
    if rgb is not None:
        red, green, blue = rgb.astype(np.uint32).T
        points["rgb"] = red << 16 | green << 8 | blue
    fields = [
        # RViz and PCL expect colours to be named as floats
        {"name": name, "offset": 4 * place, "datatype": _FLOAT32, "count": 1}
        for place, name in enumerate(names)
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
    """The files of a frame from which its points were read."""
    source = Path(sparse.path)
    is_sampled = sparse.kind == "sampled"
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
    """The options by which the points of a frame were read."""
    scan = ScanOptions(
        calib=None if sparse.calibration is None else Path(sparse.calibration),
        extrinsics=None if sparse.extrinsics is None else Path(sparse.extrinsics),
        camera=sparse.camera,
        keep_occluded=sparse.keep_occluded,
    )
    return ReadOptions(
        unit_scale=sparse.unit_scale, registration="off", scan=scan, sample=sparse.sampled
    )


def _points_used(frame: ExportFrame, notes: list[str]) -> NDArray[np.float32] | None:
    """(N, 3) the frame's own points that were used, read again as its record says.

    None, with a note, where their files are gone or give other points.
    """
    sparse = frame.result.record.inputs.get("sparse")
    result = frame.result.record.result
    if sparse is None or result is None:
        return None
    points = result.points
    # The files are read as the record says.
    seed = result.settings.get("seed") or 0
    holdout = result.settings.get("holdout") or 0.0
    try:
        read = read_frame(
            _files_of_points(frame, sparse),
            _options_of_points(sparse),
            seed=int(seed),
            holdout=float(holdout),
        )
    except (PnpDepthError, ValueError) as error:
        notes.append(f"warning: {frame.result.name}: its points are left out: {error}")
        return None
    # They must be the points of the record: as many, from the same nearest to the same farthest.
    used = read.points
    ends = (float(read.own.depth.min()), float(read.own.depth.max()))
    wanted = points.used - (points.moved or 0)
    if len(used) != wanted or not np.allclose(ends, (points.nearest, points.farthest), rtol=1e-6):
        notes.append(
            f"warning: {frame.result.name}: its points are left out, as {sparse.path} gives others"
            f" now: {len(used):,} from {ends[0]:g} to {ends[1]:g}, not {wanted:,} from"
            f" {points.nearest:g} to {points.farthest:g}"
        )
        return None
    xyz = unproject(frame.camera, used.xy.numpy().astype(np.float64), used.depth.numpy())
    return xyz.astype(np.float32)


EXPORT = Export(needs_pose=False, files=_files, write=_write, in_model_units=False)
