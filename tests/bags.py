"""Small bags with a camera and a LiDAR, written by rosbags."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from pnpdepth_cli.io.bags.bag import message_types

HEIGHT, WIDTH, FOCAL_PX = 48, 64, 60.0
IMAGES, POINTS = "/front/image_raw", "/lidar/points"


@dataclass(frozen=True, kw_only=True)
class View:
    """What camera and LiDAR see, the same in every frame, and the camera's camera_info."""

    pixels: np.ndarray
    """(H, W, 3) uint8."""
    points: np.ndarray
    """(N, 3) metres in the LiDAR's frame."""
    k: np.ndarray
    d: np.ndarray
    r: np.ndarray
    p: np.ndarray
    topic: str = IMAGES


def write_bag(
    path: Path,
    *,
    frames: int = 3,
    compressed: bool = False,
    static: bool = True,
    info: bool = True,
    poses: str = "",
    compression: Any = None,
    view: View | None = None,
) -> Path:
    """A bag of ROS 1 (.bag), ROS 2 with MCAP (.mcap) or SQLite (a folder), by the path's suffix.

    Images have 30 ms between them, and each a scan 4 ms later; the scans are of a wall 5 m ahead.
    With `poses`, base moves 0.3 m along x from one image to the next: "odometry" or "tf", or the
    camera does: "pose". `compression` is rosbags' of the chunks. `view` replaces image, scan and
    camera_info.
    """
    ros1 = path.suffix == ".bag"
    store = message_types(ros1=ros1)
    opened = _writer(path)
    if compression is not None:
        opened.set_compression(compression)
    with opened as writer:
        connections: dict[str, Any] = {}
        messages = _messages(store.types, ros1, frames, compressed, static, info, poses, view)
        for topic, time_ns, message in messages:
            kind = message.__msgtype__
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=store)
            encode = store.serialize_ros1 if ros1 else store.serialize_cdr
            writer.write(connections[topic], time_ns, encode(message, kind))
    if path.suffix == ".mcap":
        (inner,) = path.with_suffix(".folder").glob("*.mcap")
        inner.rename(path)
    return path


def _writer(path: Path) -> Any:
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import StoragePlugin
    from rosbags.rosbag2 import Writer as Writer2

    if path.suffix == ".bag":
        return Writer1(path)
    if path.suffix == ".mcap":
        folder = path.with_suffix(".folder")
        return Writer2(folder, version=9, storage_plugin=StoragePlugin.MCAP)
    return Writer2(path, version=9)


def _messages(
    types: Any,
    ros1: bool,
    frames: int,
    compressed: bool,
    static: bool,
    info: bool,
    poses: str,
    view: View | None,
) -> Iterator[tuple[str, int, Any]]:
    def header(time_ns: int, frame: str) -> Any:
        stamp = types["builtin_interfaces/msg/Time"](sec=time_ns // 10**9, nanosec=time_ns % 10**9)
        more = {"seq": 0} if ros1 else {}
        return types["std_msgs/msg/Header"](stamp=stamp, frame_id=frame, **more)

    start = 1_700_000_000 * 10**9
    if static:
        yield "/tf_static", start, _transforms(types, header)
    for number in range(frames):
        time_ns = start + 30_000_000 * number
        if info:
            yield (
                "/front/camera_info",
                time_ns,
                _camera_info(types, header(time_ns, "camera"), ros1, view),
            )
        if poses:
            yield _moved(types, header(time_ns - 15_000_000, "odom"), 0.3 * number - 0.15, poses)
        pixels = np.full((HEIGHT, WIDTH, 3), 40 + number % 200, np.uint8)
        pixels[:, : WIDTH // 2, 0] = 200
        pixels = pixels if view is None else view.pixels
        topic = IMAGES if view is None else view.topic
        yield _image(types, header(time_ns, "camera"), pixels, time_ns, topic, compressed)
        cloud = _cloud(types, header(time_ns + 4_000_000, "lidar"), view)
        yield POINTS, time_ns + 5_000_000, cloud
    if poses:
        last = start + 30_000_000 * frames - 15_000_000
        yield _moved(types, header(last, "odom"), 0.3 * frames - 0.15, poses)


def _moved(types: Any, header: Any, x: float, kind: str) -> tuple[str, int, Any]:
    """The pose of base, or for "pose" of the camera, at x metres."""
    time_ns = header.stamp.sec * 10**9 + header.stamp.nanosec
    turn = types["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0)
    vector = types["geometry_msgs/msg/Vector3"](x=x, y=0.0, z=0.0)
    if kind == "tf":
        transform = types["geometry_msgs/msg/Transform"](translation=vector, rotation=turn)
        link = types["geometry_msgs/msg/TransformStamped"](
            header=header, child_frame_id="base", transform=transform
        )
        return "/tf", time_ns, types["tf2_msgs/msg/TFMessage"](transforms=[link])
    point = types["geometry_msgs/msg/Point"](x=x, y=0.0, z=0.0)
    pose = types["geometry_msgs/msg/Pose"](position=point, orientation=turn)
    if kind == "pose":
        message = types["geometry_msgs/msg/PoseStamped"](header=header, pose=pose)
        return "/vio/pose", time_ns, message
    still = types["geometry_msgs/msg/Vector3"](x=0.0, y=0.0, z=0.0)
    twist = types["geometry_msgs/msg/Twist"](linear=still, angular=still)
    with_twist = types["geometry_msgs/msg/TwistWithCovariance"](
        twist=twist, covariance=np.zeros(36)
    )
    with_pose = types["geometry_msgs/msg/PoseWithCovariance"](pose=pose, covariance=np.zeros(36))
    message = types["nav_msgs/msg/Odometry"](
        header=header, child_frame_id="base", pose=with_pose, twist=with_twist
    )
    return "/odom", time_ns, message


def _transforms(types: Any, header: Any) -> Any:
    """camera is in base, and so is lidar: x forward, y left, z up, 0.2 m above the camera."""

    def link(child: str, shift: tuple[float, ...], xyzw: tuple[float, ...]) -> Any:
        return types["geometry_msgs/msg/TransformStamped"](
            header=header(10**9, "base"),
            child_frame_id=child,
            transform=types["geometry_msgs/msg/Transform"](
                translation=types["geometry_msgs/msg/Vector3"](
                    **dict(zip("xyz", shift, strict=True))
                ),
                rotation=types["geometry_msgs/msg/Quaternion"](
                    **dict(zip("xyzw", xyzw, strict=True))
                ),
            ),
        )

    camera = link("camera", (1.0, 0.0, 0.0), (-0.5, 0.5, -0.5, 0.5))
    lidar = link("lidar", (1.0, 0.0, 0.2), (0.0, 0.0, 0.0, 1.0))
    return types["tf2_msgs/msg/TFMessage"](transforms=[camera, lidar])


def _camera_info(types: Any, header: Any, ros1: bool, view: View | None) -> Any:
    matrix = [FOCAL_PX, 0, 31.5, 0, FOCAL_PX, 23.5, 0, 0, 1.0]
    values = {
        "d": np.zeros(5),
        "k": np.array(matrix),
        "r": np.eye(3).ravel(),
        "p": np.zeros(12),
    }
    if view is not None:
        values = {name: getattr(view, name).ravel().astype(float) for name in "dkrp"}
    height, width = (HEIGHT, WIDTH) if view is None else view.pixels.shape[:2]
    return types["sensor_msgs/msg/CameraInfo"](
        header=header,
        height=height,
        width=width,
        distortion_model="plumb_bob",
        binning_x=0,
        binning_y=0,
        roi=types["sensor_msgs/msg/RegionOfInterest"](
            x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
        ),
        **{name.upper() if ros1 else name: value for name, value in values.items()},
    )


def _image(
    types: Any, header: Any, pixels: np.ndarray, time_ns: int, topic: str, compressed: bool
) -> tuple[str, int, Any]:
    if compressed:
        data = cv2.imencode(".jpg", pixels[:, :, ::-1])[1].ravel()
        message = types["sensor_msgs/msg/CompressedImage"](header=header, format="jpeg", data=data)
        return f"{topic}/compressed", time_ns, message
    height, width = pixels.shape[:2]
    padded = np.zeros((height, width * 3 + 8), np.uint8)  # rows may be longer than their pixels
    padded[:, : width * 3] = pixels.reshape(height, -1)
    message = types["sensor_msgs/msg/Image"](
        header=header,
        height=height,
        width=width,
        encoding="rgb8",
        is_bigendian=0,
        step=padded.shape[1],
        data=padded.ravel(),
    )
    return topic, time_ns, message


def _cloud(types: Any, header: Any, view: View | None) -> Any:
    """Fields that are not x y z, and not in this order; one point without return."""
    layout = np.dtype(
        {
            "names": ["ring", "z", "y", "x"],
            "formats": ["<u2", "<f4", "<f4", "<f8"],
            "offsets": [0, 4, 8, 16],
            "itemsize": 28,
        }
    )
    y, z = np.meshgrid(np.linspace(-2, 2, 15), np.linspace(-1.5, 1.5, 10))
    points = np.zeros(151, layout)
    points["x"], points["y"][:150], points["z"][:150] = 5.0, y.ravel(), z.ravel()
    points["x"][150] = np.nan
    if view is not None:
        points = np.zeros(len(view.points), layout)
        points["x"], points["y"], points["z"] = view.points.T
    kinds = {"ring": 4, "z": 7, "y": 7, "x": 8}
    fields = [
        types["sensor_msgs/msg/PointField"](
            name=name, offset=layout.fields[name][1], datatype=kinds[name], count=1
        )
        for name in layout.names
    ]
    return types["sensor_msgs/msg/PointCloud2"](
        header=header,
        height=1,
        width=len(points),
        fields=fields,
        is_bigendian=False,
        point_step=layout.itemsize,
        row_step=layout.itemsize * len(points),
        data=np.frombuffer(points.tobytes(), np.uint8),
        is_dense=False,
    )
