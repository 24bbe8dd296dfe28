"""A bag that is read message by message.

Messages are decoded as the released ROS message types define them. The definitions in the bag
itself are not used, because rosbags makes Python code of them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from pnpdepth_cli.errors import FileFormatError, InputError, PnpDepthError, UsageError
from pnpdepth_cli.io.bags.bounds import bound_decompression, check_bag
from pnpdepth_cli.io.file_bytes import one_line

BAG_SUFFIXES = (".bag", ".mcap", ".db3")
IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
CLOUDS = ("sensor_msgs/msg/PointCloud2",)
CAMERAS = ("sensor_msgs/msg/CameraInfo",)
TRANSFORMS = ("tf2_msgs/msg/TFMessage",)


def is_bag(path: Path) -> bool:
    """Returns whether this is a bag file, or a folder that ROS 2 recorded."""
    if path.is_dir():
        return (path / "metadata.yaml").is_file()
    return path.suffix.lower() in BAG_SUFFIXES


class Bag:
    """An open bag; made by `open_bag`."""

    def __init__(self, path: Path, reader: Any, typestore: Any, *, ros1: bool) -> None:
        self.path = path
        self._reader = reader
        self._decode = typestore.deserialize_ros1 if ros1 else typestore.deserialize_cdr

    def topics(self, kinds: Sequence[str]) -> dict[str, int]:
        """Returns the topics of these message types with their number of messages.

        Raises:
            FileFormatError: The bag is damaged.
        """
        with _as_our_errors(self.path):
            return {
                name: int(info.msgcount)
                for name, info in sorted(self._reader.topics.items())
                if info.msgtype in kinds
            }

    def messages(self, topics: Sequence[str]) -> Iterator[tuple[str, int, Any]]:
        """Yields (topic, nanoseconds at which it was logged, message) in the order of the log.

        Raises:
            FileFormatError: The bag is damaged.
        """
        wanted = [each for each in self._reader.connections if each.topic in topics]
        if not wanted:
            return
        with _as_our_errors(self.path):
            for connection, time_ns, data in self._reader.messages(connections=wanted):
                yield connection.topic, int(time_ns), self._decode(data, connection.msgtype)


@contextmanager
def open_bag(path: Path) -> Iterator[Bag]:
    """Yields the bag in a file (.bag, .mcap, .db3) or in a folder with metadata.yaml.

    Raises:
        InputError: There is none.
        FileFormatError: It is cut short, or no bag.
        UsageError: rosbags is not installed.
    """
    try:
        from rosbags.rosbag1 import Reader as Reader1
        from rosbags.rosbag2 import Reader as Reader2
    except ImportError:
        raise UsageError(f"reading {path} needs rosbags: pip install 'pnpdepth[ros]'") from None
    if not path.exists():
        raise InputError(f"{path}: no such file; check the path")
    ros1 = path.suffix.lower() == ".bag"
    bound_decompression()
    with _as_our_errors(path):
        check_bag(path)
        reader: Any = Reader1(path) if ros1 else Reader2(path)
        reader.open()
    try:
        yield Bag(path, reader, message_types(ros1=ros1), ros1=ros1)
    finally:
        reader.close()


def message_types(*, ros1: bool) -> Any:
    """Returns rosbags' type store of ROS 1 Noetic or ROS 2 Humble."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    if not ros1:
        return get_typestore(Stores.ROS2_HUMBLE)
    store = get_typestore(Stores.ROS1_NOETIC)
    transforms = "geometry_msgs/TransformStamped[] transforms"  # the store lacks tf2_msgs
    store.register(get_types_from_msg(transforms, TRANSFORMS[0]))
    return store


def topic_of(bag: Bag, wanted: str | None, kinds: Sequence[str], option: str) -> str:
    """Returns the topic that is named, or the only one of these message types.

    Raises:
        UsageError: The named one is not there, or there are several or none.
    """
    topics = bag.topics(kinds)
    listing = ", ".join(f"{name} ({count:,} messages)" for name, count in topics.items())
    if wanted is not None:
        if wanted not in topics:
            raise UsageError(
                f"{bag.path} has no topic {wanted} of {kinds[0]}; there are {listing or 'none'}"
            )
        return wanted
    # an image and its compressed copy are one camera
    names = [n for n in topics if not (n.endswith("/compressed") and n[:-11] in topics)]
    if len(names) != 1:
        what = f"several topics of {kinds[0]}" if names else f"no topic of {kinds[0]}"
        raise UsageError(f"{bag.path} has {what}; choose with {option}: {listing or 'none'}")
    return names[0]


@contextmanager
def _as_our_errors(path: Path) -> Iterator[None]:
    try:
        yield
    except (PnpDepthError, GeneratorExit):
        raise
    except Exception as error:  # rosbags raises many kinds on damaged files
        raise FileFormatError(
            f"{path} cannot be read as a bag ({type(error).__name__}: {one_line(error)}); if it is"
            " cut short, repair it with `mcap recover`, `ros2 bag reindex` or `rosbag reindex`"
        ) from error
