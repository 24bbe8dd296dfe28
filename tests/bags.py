"""Small bags with a camera and a LiDAR, written by rosbags."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from pnpdepth_cli.io.bags import message_types

HEIGHT, WIDTH, FOCAL_PX, RECTIFIED_PX = 48, 64, 60.0, 70.0
IMAGES, POINTS = "/front/image_raw", "/lidar/points"
Fields = dict[str, Any]
"""Of a message, nested."""


def write_bag(
    path: Path,
    *,
    frames: int = 3,
    topic: str = IMAGES,
    without: str = "",
    poses: str = "",
    compression: Any = None,
    clock_s: float = 0.0,
    depth: str = "",
    depth_frame: str = "camera",
    depth_focal: float = FOCAL_PX,
    depth_topic: str = "/depth/image_raw",
    unit: tuple[str, float] | None = None,
) -> Path:
    """A bag of ROS 1 (.bag), ROS 2 with MCAP (.mcap) or SQLite (a folder), by the path's suffix.

    Images have 30 ms between them, and each a scan 4 ms later; the scans are of a wall 5 m ahead.
    The images are JPEG where their topic ends in compressed. `without` is a topic that is not
    there. With `poses`, base moves 0.3 m along x from one image to the next: "/odom", or the
    camera does: "/vio/pose". `compression` is rosbags' of the chunks. `clock_s` is added to the
    stamps of the scans. With `depth`, an encoding such as "16UC1" or "32FC1; compressedDepth",
    `depth_m` is there instead of scans. `unit` is a topic and the metres of a code that it states.
    """

    def messages() -> Iterator[tuple[str, int, str, Fields]]:
        start = 1_700_000_000 * 10**9
        step = 30_000_000
        if unit is not None:
            yield unit[0], start, "std_msgs/msg/Float32", {"data": np.float32(unit[1])}
        yield "/tf_static", start, "tf2_msgs/msg/TFMessage", {"transforms": _transforms()}
        for number in range(frames + 1):
            time_ns = start + step * number
            if poses:
                stamp = _header(time_ns - step // 2, "odom")
                yield (poses, time_ns - step // 2, *_moved(stamp, 0.3 * number - 0.15, poses))
            if number == frames:
                return
            stamp = _header(time_ns, "camera")
            yield ("/front/camera_info", time_ns, *_camera_info(stamp, FOCAL_PX, RECTIFIED_PX))
            pixels = np.full((HEIGHT, WIDTH, 3), 40 + number % 200, np.uint8)
            pixels[:, : WIDTH // 2, 0] = 200
            if topic.endswith("compressed"):
                jpeg = cv2.imencode(".jpg", pixels[:, :, ::-1])[1].ravel()
                yield (topic, time_ns, *_compressed(stamp, "jpeg", jpeg))
            else:
                yield (topic, time_ns, *_image(stamp, pixels, "rgb8"))
            later_ns = time_ns + 5_000_000
            if depth:
                stamp = _header(time_ns + 4_000_000, depth_frame)
                info = _camera_info(stamp, depth_focal, depth_focal)
                yield ("/depth/camera_info", later_ns, *info)
                suffix = "/compressedDepth" if "compressed" in depth else ""
                coded = _depth(stamp, depth, 0.001 if unit is None else unit[1])
                yield (f"{depth_topic}{suffix}", later_ns, *coded)
            else:
                stamp = _header(time_ns + 4_000_000 + round(clock_s * 1e9), "lidar")
                yield (POINTS, later_ns, *_cloud(stamp))

    ros1 = path.suffix == ".bag"
    store = message_types(ros1=ros1)
    opened = _writer(path)
    if compression is not None:
        opened.set_compression(compression)
    with opened as writer:
        connections: dict[str, Any] = {}
        for name, time_ns, kind, fields in messages():
            if name == without:
                continue
            if name not in connections:
                connections[name] = writer.add_connection(name, kind, typestore=store)
            encode = store.serialize_ros1 if ros1 else store.serialize_cdr
            writer.write(connections[name], time_ns, encode(_message(store, kind, fields), kind))
    if path.suffix == ".mcap":
        (inner,) = path.with_suffix(".folder").glob("*.mcap")
        inner.rename(path)
    return path


def _writer(path: Path) -> Any:
    from rosbags import rosbag1, rosbag2

    if path.suffix == ".bag":
        return rosbag1.Writer(path)
    if path.suffix == ".mcap":
        plugin = rosbag2.StoragePlugin.MCAP
        return rosbag2.Writer(path.with_suffix(".folder"), version=9, storage_plugin=plugin)
    return rosbag2.Writer(path, version=9)


def _message(store: Any, kind: str, given: Mapping[str, Any]) -> Any:
    """A message of nested fields; what is not given is zero."""
    from rosbags.interfaces import Nodetype

    values: Fields = {}
    for name, (node, of) in store.fielddefs[kind][1]:
        value = given.get(name.lower())  # ROS 1 has D, K, R and P
        if node is Nodetype.NAME:
            values[name] = _message(store, of, value or {})
        elif node is Nodetype.BASE:
            values[name] = value or ("" if of[0] == "string" else 0)
        elif of[0][0] is Nodetype.NAME:
            values[name] = [_message(store, of[0][1], nested) for nested in value]
        else:
            values[name] = np.zeros(of[1]) if value is None else value
    return store.types[kind](**values)


def _header(time_ns: int, frame: str) -> Fields:
    seconds, rest = divmod(time_ns, 10**9)
    return {"stamp": {"sec": seconds, "nanosec": rest}, "frame_id": frame}


def _moved(header: Fields, x: float, topic: str) -> tuple[str, Fields]:
    """The pose of base, or of the camera, at x metres."""
    pose = {"position": {"x": x}, "orientation": {"w": 1.0}}
    if topic != "/odom":
        return "geometry_msgs/msg/PoseStamped", {"header": header, "pose": pose}
    odometry = {"header": header, "child_frame_id": "base", "pose": {"pose": pose}}
    return "nav_msgs/msg/Odometry", odometry


def _transforms() -> list[Fields]:
    """camera is in base, and so is lidar: x forward, y left, z up, 0.2 m above the camera.

    The camera of depth is 0.05 m left of the camera.
    """
    ahead = {"x": -0.5, "y": 0.5, "z": -0.5, "w": 0.5}  # z of the camera is base's x
    places = {
        "camera": ({"x": 1.0}, ahead),
        "lidar": ({"x": 1.0, "z": 0.2}, {"w": 1.0}),
        "depth": ({"x": 1.0, "y": 0.05}, ahead),
    }
    return [
        {
            "header": _header(10**9, "base"),
            "child_frame_id": name,
            "transform": {"translation": shift, "rotation": rotation},
        }
        for name, (shift, rotation) in places.items()
    ]


def _camera_info(header: Fields, focal: float, rectified: float) -> tuple[str, Fields]:
    fields = {
        "header": header,
        "height": HEIGHT,
        "width": WIDTH,
        "distortion_model": "plumb_bob",
        "d": np.zeros(5),
        "k": np.array([focal, 0, 31.5, 0, focal, 23.5, 0, 0, 1.0]),
        "r": np.eye(3).ravel(),
        "p": np.array([rectified, 0, 31.5, 0, 0, rectified, 23.5, 0, 0, 0, 1.0, 0]),
    }
    return "sensor_msgs/msg/CameraInfo", fields


def _compressed(header: Fields, kind: str, data: np.ndarray) -> tuple[str, Fields]:
    return "sensor_msgs/msg/CompressedImage", {"header": header, "format": kind, "data": data}


def _image(header: Fields, pixels: np.ndarray, encoding: str) -> tuple[str, Fields]:
    """An image whose rows are longer than their pixels."""
    height, width = pixels.shape[:2]
    rows = np.pad(pixels.reshape(height, -1).view(np.uint8), ((0, 0), (0, 8)))
    fields = {"header": header, "encoding": encoding, "height": height, "width": width}
    return "sensor_msgs/msg/Image", {**fields, "step": rows.shape[1], "data": rows.ravel()}


def depth_m() -> np.ndarray:
    """(HEIGHT, WIDTH) metres: a wall 4 m ahead, unknown in the first rows."""
    depth = np.full((HEIGHT, WIDTH), 4.0, np.float32)
    depth[:10] = 0
    return depth


def _depth(header: Fields, kind: str, unit_m: float = 0.001) -> tuple[str, Fields]:
    """The message of `depth_m`, whose codes have so many metres."""
    depth = depth_m()
    (encoding, _, compressed) = kind.partition("; ")
    kinds = {"32FC1": "<f4", "64FC1": "<f8"}
    codes = (depth / unit_m).round().astype("<u2")
    if encoding in kinds:
        codes = depth.astype(kinds[encoding])
    if not compressed:
        return _image(header, codes, encoding)
    # compressed_depth_image_transport with depth_quantization = 100, depth_max = 10
    a = 100.0 * (100 + 1)
    b = 1 - a / 10
    if encoding == "32FC1":
        codes = np.where(depth > 0, a / np.maximum(depth, 1) + b, 0).astype(np.uint16)
    png = cv2.imencode(".png", codes)[1].ravel()
    start = np.frombuffer(np.array([a, b], "<f4").tobytes(), np.uint8)
    return _compressed(header, kind, np.concatenate([np.zeros(4, np.uint8), start, png]))


def _cloud(header: Fields) -> tuple[str, Fields]:
    """Fields that are not x y z, and not in this order; one point without return."""
    names, formats, offsets = ["ring", "z", "y", "x"], ["<u2", "<f4", "<f4", "<f8"], [0, 4, 8, 16]
    layout = np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": 28})
    y, z = np.meshgrid(np.linspace(-2, 2, 15), np.linspace(-1.5, 1.5, 10))
    points = np.zeros(151, layout)
    points["x"] = 5.0
    points["y"][:150] = y.ravel()
    points["z"][:150] = z.ravel()
    points["x"][150] = np.nan
    fields = [
        {"name": name, "offset": offset, "datatype": kind, "count": 1}
        for name, offset, kind in zip(names, offsets, [4, 7, 7, 8], strict=True)
    ]
    data = np.frombuffer(points.tobytes(), np.uint8)
    step = layout.itemsize
    sizes = {"height": 1, "width": len(points), "point_step": step, "row_step": data.size}
    return "sensor_msgs/msg/PointCloud2", sizes | {"header": header, "fields": fields, "data": data}
