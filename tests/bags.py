"""Small bags with a camera and a LiDAR, written by rosbags."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from pnpdepth_cli.io.bags import message_types

HEIGHT, WIDTH, FOCAL_PX, RECTIFIED_PX = 48, 64, 60.0, 70.0
IMAGES, POINTS = "/front/image_raw", "/lidar/points"


Make = Callable[..., Any]
"""Makes a message of a type such as "std_msgs/Header" of its fields."""


def write_bag(
    path: Path,
    *,
    frames: int = 3,
    compressed: bool = False,
    static: bool = True,
    info: bool = True,
    poses: str = "",
    compression: Any = None,
    topic: str = IMAGES,
    rectified: bool = False,
    clock_s: float = 0.0,
    depth: str = "",
    depth_frame: str = "camera",
    depth_focal: float = FOCAL_PX,
) -> Path:
    """A bag of ROS 1 (.bag), ROS 2 with MCAP (.mcap) or SQLite (a folder), by the path's suffix.

    Images have 30 ms between them, and each a scan 4 ms later; the scans are of a wall 5 m ahead.
    With `poses`, base moves 0.3 m along x from one image to the next: "odometry", or the camera
    does: "pose". `compression` is rosbags' of the chunks. With `rectified`, camera_info has a
    camera of rectified images, of `RECTIFIED_PX`. `clock_s` is added to the stamps of the scans.
    With `depth`, an encoding such as "16UC1" or "32FC1; compressedDepth", `depth_m` is there
    instead of scans.
    """
    ros1 = path.suffix == ".bag"
    store = message_types(ros1=ros1)

    def make(kind: str, **fields: Any) -> Any:
        return store.types[kind.replace("/", "/msg/")](**fields)

    def header(time_ns: int, frame: str) -> Any:
        stamp = make("builtin_interfaces/Time", sec=time_ns // 10**9, nanosec=time_ns % 10**9)
        more = {"seq": 0} if ros1 else {}
        return make("std_msgs/Header", stamp=stamp, frame_id=frame, **more)

    def messages() -> Iterator[tuple[str, int, Any]]:
        start, step = 1_700_000_000 * 10**9, 30_000_000
        if static:
            yield "/tf_static", start, _transforms(make, header)
        for number in range(frames + 1):
            time_ns = start + step * number
            if poses:
                stamp = header(time_ns - step // 2, "odom")
                yield _moved(make, stamp, 0.3 * number - 0.15, poses)
            if number == frames:
                return
            stamp = header(time_ns, "camera")
            if info:
                yield "/front/camera_info", time_ns, _camera_info(make, stamp, ros1, rectified)
            pixels = np.full((HEIGHT, WIDTH, 3), 40 + number % 200, np.uint8)
            pixels[:, : WIDTH // 2, 0] = 200
            if compressed:
                jpeg = cv2.imencode(".jpg", pixels[:, :, ::-1])[1].ravel()
                yield f"{topic}/compressed", time_ns, _compressed(make, stamp, "jpeg", jpeg)
            else:
                yield topic, time_ns, _image(make, stamp, pixels, "rgb8")
            later_ns = time_ns + 5_000_000
            if depth:
                stamp = header(time_ns + 4_000_000, depth_frame)
                of_depth = _camera_info(make, stamp, ros1, False, depth_focal)
                yield "/depth/camera_info", later_ns, of_depth
                name, message = _depth(make, stamp, depth)
                yield name, later_ns, message
            else:
                stamp = header(time_ns + 4_000_000 + round(clock_s * 1e9), "lidar")
                yield POINTS, later_ns, _cloud(make, stamp)

    opened = _writer(path)
    if compression is not None:
        opened.set_compression(compression)
    with opened as writer:
        connections: dict[str, Any] = {}
        for name, time_ns, message in messages():
            kind = message.__msgtype__
            if name not in connections:
                connections[name] = writer.add_connection(name, kind, typestore=store)
            encode = store.serialize_ros1 if ros1 else store.serialize_cdr
            writer.write(connections[name], time_ns, encode(message, kind))
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


def _link(make: Make, header: Any, child: str, shift: Sequence[float], xyzw: Any) -> Any:
    """A transform: the pose of the child in the frame of the header."""
    transform = make(
        "geometry_msgs/Transform",
        translation=make("geometry_msgs/Vector3", **dict(zip("xyz", shift, strict=True))),
        rotation=make("geometry_msgs/Quaternion", **dict(zip("xyzw", xyzw, strict=True))),
    )
    return make(
        "geometry_msgs/TransformStamped", header=header, child_frame_id=child, transform=transform
    )


def _moved(make: Make, header: Any, x: float, kind: str) -> tuple[str, int, Any]:
    """The pose of base, or for "pose" of the camera, at x metres."""
    time_ns = header.stamp.sec * 10**9 + header.stamp.nanosec
    point = make("geometry_msgs/Point", x=x, y=0.0, z=0.0)
    pose = make(
        "geometry_msgs/Pose",
        position=point,
        orientation=make("geometry_msgs/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0),
    )
    if kind == "pose":
        return "/vio/pose", time_ns, make("geometry_msgs/PoseStamped", header=header, pose=pose)
    still, unknown = make("geometry_msgs/Vector3", x=0.0, y=0.0, z=0.0), np.zeros(36)
    twist = make("geometry_msgs/Twist", linear=still, angular=still)
    uncertain = {
        "pose": make("geometry_msgs/PoseWithCovariance", pose=pose, covariance=unknown),
        "twist": make("geometry_msgs/TwistWithCovariance", twist=twist, covariance=unknown),
    }
    odometry = make("nav_msgs/Odometry", header=header, child_frame_id="base", **uncertain)
    return "/odom", time_ns, odometry


def _transforms(make: Make, header: Make) -> Any:
    """camera is in base, and so is lidar: x forward, y left, z up, 0.2 m above the camera.

    The camera of depth is 0.05 m left of the camera.
    """
    base = header(10**9, "base")
    camera = _link(make, base, "camera", (1.0, 0.0, 0.0), (-0.5, 0.5, -0.5, 0.5))
    lidar = _link(make, base, "lidar", (1.0, 0.0, 0.2), (0.0, 0.0, 0.0, 1.0))
    depth = _link(make, base, "depth", (1.0, 0.05, 0.0), (-0.5, 0.5, -0.5, 0.5))
    return make("tf2_msgs/TFMessage", transforms=[camera, lidar, depth])


def _camera_info(
    make: Make, header: Any, ros1: bool, rectified: bool, focal: float = FOCAL_PX
) -> Any:
    matrix = np.array([focal, 0, 31.5, 0, focal, 23.5, 0, 0, 1.0])
    values = {"d": np.zeros(5), "k": matrix, "r": np.eye(3).ravel(), "p": np.zeros(12)}
    if rectified:
        values["p"] = np.array([RECTIFIED_PX, 0, 31.5, 0, 0, RECTIFIED_PX, 23.5, 0, 0, 0, 1.0, 0])
    whole = {"x_offset": 0, "y_offset": 0, "height": 0, "width": 0, "do_rectify": False}
    matrices = {name.upper() if ros1 else name: value for name, value in values.items()}
    sizes = {"height": HEIGHT, "width": WIDTH, "binning_x": 0, "binning_y": 0}
    sizes["roi"] = make("sensor_msgs/RegionOfInterest", **whole)
    matrices["distortion_model"] = "plumb_bob"
    return make("sensor_msgs/CameraInfo", header=header, **sizes, **matrices)


def _compressed(make: Make, header: Any, kind: str, data: np.ndarray) -> Any:
    return make("sensor_msgs/CompressedImage", header=header, format=kind, data=data)


def _image(make: Make, header: Any, pixels: np.ndarray, encoding: str) -> Any:
    """An image whose rows are longer than their pixels."""
    height, width = pixels.shape[:2]
    rows = np.pad(pixels.reshape(height, -1).view(np.uint8), ((0, 0), (0, 8)))
    sizes = {"height": height, "width": width, "step": rows.shape[1], "data": rows.ravel()}
    return make("sensor_msgs/Image", header=header, encoding=encoding, is_bigendian=0, **sizes)


def depth_m() -> np.ndarray:
    """(HEIGHT, WIDTH) metres: a wall 4 m ahead, unknown in the first rows."""
    depth = np.full((HEIGHT, WIDTH), 4.0, np.float32)
    depth[:10] = 0
    return depth


def _depth(make: Make, header: Any, kind: str) -> tuple[str, Any]:
    """The topic and the message of `depth_m`."""
    depth, (encoding, _, compressed) = depth_m(), kind.partition("; ")
    codes = (1000 * depth).astype("<u2") if encoding == "16UC1" else depth.astype("<f4")
    if not compressed:
        return "/depth/image_raw", _image(make, header, codes, encoding)
    # compressed_depth_image_transport with depth_quantization = 100, depth_max = 10
    a = 100.0 * (100 + 1)
    b = 1 - a / 10
    if encoding == "32FC1":
        codes = np.where(depth > 0, a / np.maximum(depth, 1) + b, 0).astype(np.uint16)
    png = cv2.imencode(".png", codes)[1].ravel()
    start = np.frombuffer(np.array([a, b], "<f4").tobytes(), np.uint8)
    data = np.concatenate([np.zeros(4, np.uint8), start, png])
    return "/depth/image_raw/compressedDepth", _compressed(make, header, kind, data)


def _cloud(make: Make, header: Any) -> Any:
    """Fields that are not x y z, and not in this order; one point without return."""
    names, formats, offsets = ["ring", "z", "y", "x"], ["<u2", "<f4", "<f4", "<f8"], [0, 4, 8, 16]
    layout = np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": 28})
    y, z = np.meshgrid(np.linspace(-2, 2, 15), np.linspace(-1.5, 1.5, 10))
    points = np.zeros(151, layout)
    points["x"], points["y"][:150], points["z"][:150] = 5.0, y.ravel(), z.ravel()
    points["x"][150] = np.nan
    fields = [
        make("sensor_msgs/PointField", name=name, offset=offset, datatype=kind, count=1)
        for name, offset, kind in zip(names, offsets, [4, 7, 7, 8], strict=True)
    ]
    data, step = np.frombuffer(points.tobytes(), np.uint8), layout.itemsize
    sizes = {"height": 1, "width": len(points), "point_step": step, "row_step": data.size}
    kind = {"fields": fields, "is_bigendian": False, "is_dense": False}
    return make("sensor_msgs/PointCloud2", header=header, data=data, **sizes, **kind)
