"""Bags of ROS 1, ROS 2 and MCAP, read message by message.

Messages are decoded as the released ROS message types define them. The definitions in the bag
itself are not used, because rosbags makes Python code of them.

rosbags decompresses whatever a chunk holds, and a chunk of a few kilobytes can hold gigabytes. It
runs what SQLite stores, and a schema can hold views and generated columns, which are computed when
they are read. Both are bounded here.
"""

from __future__ import annotations

import bz2
import functools
import importlib
import sqlite3
import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

from pnpdepth_cli.budget import max_file_bytes
from pnpdepth_cli.errors import InputError, UsageError
from pnpdepth_cli.io.file_bytes import one_line, parse_yaml, read_bytes, size_of_regular_file

if TYPE_CHECKING:
    from rosbags.rosbag1 import Reader as Reader1
    from rosbags.rosbag2 import Reader as Reader2
    from rosbags.typesys.store import Typestore

IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
CLOUDS = ("sensor_msgs/msg/PointCloud2",)
CAMERAS = ("sensor_msgs/msg/CameraInfo",)
ODOMETRY = ("nav_msgs/msg/Odometry",)
POSES = ("geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/PoseWithCovarianceStamped")
FLOATS = ("std_msgs/msg/Float32", "std_msgs/msg/Float64")
TRANSFORMS = ("tf2_msgs/msg/TFMessage",)
COMPRESSED = ("/compressed", "/compressedDepth")
"""Ends of the names of topics of compressed images."""

Message = Any
"""A ROS message, whose type rosbags makes when it runs."""


def is_bag(path: Path) -> bool:
    """Returns whether a path is a bag file, by its suffix, or a folder that ROS 2 recorded."""
    if path.is_dir():
        return (path / "metadata.yaml").is_file()
    return path.suffix.lower() in (".bag", ".mcap", ".db3")


@dataclass(frozen=True, kw_only=True)
class Bag:
    """An open bag; made by `open_bag`."""

    path: Path
    reader: Reader1 | Reader2
    decode: Callable[[bytes, str], Message]
    """Function of a message's bytes and the name of its type."""

    def topics(self, kinds: Sequence[str]) -> dict[str, int]:
        """Returns the number of messages by topic, of topics with one of these message types.

        Raises:
            InputError: The bag is damaged.
        """
        with _as_our_errors(self.path):
            topics = sorted(self.reader.topics.items())
            return {name: int(topic.msgcount) for name, topic in topics if topic.msgtype in kinds}

    def messages(self, topics: Sequence[str]) -> Iterator[tuple[str, int, Message]]:
        """Yields (topic, nanoseconds at which it was logged, message) in the order of the log.

        Args:
            topics: Names of topics; those that the bag does not have are ignored.

        Raises:
            InputError: The bag is damaged.
        """
        wanted = [
            connection for connection in self.reader.connections if connection.topic in topics
        ]
        if not wanted:  # rosbags would yield all messages
            return
        with _as_our_errors(self.path):
            for connection, time_ns, data in self.reader.messages(connections=wanted):
                yield connection.topic, int(time_ns), self.decode(data, connection.msgtype)


@contextmanager
def open_bag(path: Path) -> Iterator[Bag]:
    """Yields the bag in a file (.bag, .mcap, .db3) or in a folder with metadata.yaml.

    The bag is closed at the end of the block.

    Raises:
        InputError: The path has no bag, or the bag is damaged or cut short.
        UsageError: rosbags is not installed.
    """
    try:
        from rosbags.rosbag1 import Reader as Reader1
        from rosbags.rosbag2 import Reader as Reader2
    except ImportError:
        raise UsageError(f"reading {path} needs rosbags: pip install 'pnpdepth[ros]'") from None
    # Checked before rosbags opens it, which must not decompress or compute more than is bounded.
    ros1 = path.suffix.lower() == ".bag"
    bound_decompression()
    with _as_our_errors(path):
        _check_bag(path)
        reader = Reader1(path) if ros1 else Reader2(path)
        reader.open()
    # Messages of ROS 1 and ROS 2 are encoded differently.
    try:
        types = message_types(ros1=ros1)
        decode = types.deserialize_ros1 if ros1 else types.deserialize_cdr
        yield Bag(path=path, reader=reader, decode=decode)
    finally:
        reader.close()


def message_types(*, ros1: bool) -> Typestore:
    """Returns rosbags' store of message types, by which it decodes and encodes messages.

    Args:
        ros1: Whether the types are those of ROS 1 Noetic, not of ROS 2 Humble.
    """
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    if not ros1:
        return get_typestore(Stores.ROS2_HUMBLE)
    store = get_typestore(Stores.ROS1_NOETIC)
    transforms = "geometry_msgs/TransformStamped[] transforms"  # the store lacks tf2_msgs
    store.register(get_types_from_msg(transforms, TRANSFORMS[0]))
    return store


def choose_topic(bag: Bag, wanted: Sequence[str], topics: Mapping[str, int], what: str) -> str:
    """Returns the one of several topics that the user named, or else the only one.

    Args:
        bag: Bag of the topics, for messages.
        wanted: Names of topics of any kind, which the user gave.
        topics: Number of messages by topic, as `Bag.topics` returns it, to choose from.
        what: Name of what the topics hold, for messages.

    Raises:
        UsageError: There are several or none.
    """
    names = [name for name in wanted if name in topics]
    if not names:
        # The compressed copy of an image, image/compressed, is no further camera.
        names = [
            name
            for name in topics
            if not name.endswith(COMPRESSED) or name.rpartition("/")[0] not in topics
        ]
    if len(names) != 1:
        listing = ", ".join(f"{name} ({count:,} messages)" for name, count in topics.items())
        raise UsageError(
            f"{bag.path} has {len(names)} topics of {what}, not one; choose with --topic of"
            f" `pnpdepth frames`: {listing or 'none'}"
        )
    return names[0]


def check_topics(bag: Bag, wanted: Sequence[str], kinds: Sequence[str]) -> None:
    """Raises UsageError unless the bag has all topics that the user named.

    Args:
        bag: The bag.
        wanted: Names of topics, which the user gave.
        kinds: Message types that the topics may have.
    """
    topics = bag.topics(kinds)
    missing = [name for name in wanted if name not in topics]
    if missing:
        raise UsageError(
            f"{bag.path} has no topic {missing[0]} of images, points or poses; name one of"
            f" {', '.join(topics) or 'none'}"
        )


@contextmanager
def _as_our_errors(path: Path) -> Iterator[None]:
    """Turns what rosbags raises inside the block on a damaged bag into an InputError.

    Args:
        path: The bag, for messages.
    """
    from rosbags.rosbag1 import ReaderError as Reader1Error
    from rosbags.rosbag2 import ReaderError as Reader2Error
    from rosbags.serde import SerdeError

    # The libraries that rosbags decodes by raise errors of their own.
    mcap = importlib.import_module("rosbags.rosbag2.storage_mcap")
    database = importlib.import_module("rosbags.rosbag2.storage_sqlite3")
    of_libraries = (sqlite3.Error, database.apsw.Error, mcap.zstd.ZstdError, struct.error)
    # rosbags does not check all that it reads, so Python's errors of odd content come through.
    of_content = (ValueError, LookupError, OverflowError, TypeError, AssertionError)
    of_reading = (OSError, EOFError, RuntimeError)
    of_rosbags = (Reader1Error, Reader2Error, SerdeError)
    try:
        yield
    except (*of_rosbags, *of_libraries, *of_content, *of_reading) as error:
        raise InputError(
            f"{path} cannot be read as a bag ({type(error).__name__}: {one_line(error)}); if cut"
            " short, repair it with `mcap recover`, `ros2 bag reindex` or `rosbag reindex`"
        ) from error


_CHUNK_BYTES = 1 << 28
"""Largest decompressed chunk: they are closed at 768 KiB by default, and a message of a sensor is
far smaller."""

_COMPUTED = """
    SELECT name FROM sqlite_master
    WHERE type NOT IN ('table', 'index') OR sql LIKE 'CREATE VIRTUAL%'
    UNION ALL
    SELECT m.name FROM sqlite_master m JOIN pragma_table_xinfo(m.name) x
    WHERE m.type = 'table' AND x.hidden
"""
"""Query of the names of views, triggers, virtual tables, and tables with generated columns."""


def _check_bag(path: Path) -> None:
    """Raises InputError for a bag that rosbags must not open.

    Such a bag is compressed as a whole, has a database that would compute what is read, or lacks
    its metadata.
    """
    # The folder of a ROS 2 bag: its metadata, and the files of its database.
    files = [path]
    if path.is_dir():
        files = sorted(path.glob("*.db3"))
        metadata = path / "metadata.yaml"
        if not metadata.is_file():
            raise InputError(f"{path} has no metadata.yaml of a ROS 2 bag; give its own folder")
        match parse_yaml(metadata, read_bytes(metadata).decode("utf-8", "replace")):
            case {"rosbag2_bagfile_information": dict(information)}:
                if str(information.get("compression_mode", "")).lower() not in ("", "none"):
                    raise InputError(f"{path}: the bag is compressed; `ros2 bag convert` it")
            case _:
                raise InputError(f"{metadata} is no metadata of a bag; repair it: ros2 bag reindex")
    # Each file.
    for file in files:
        size_of_regular_file(file)
        if file.suffix.lower() == ".db3":
            _check_database(file)


def _check_database(path: Path) -> None:
    """Raises InputError if an SQLite database would compute what is read from it."""
    # Immutable, so that SQLite neither locks the file nor writes beside it.
    uri = f"{path.absolute().as_uri()}?immutable=1"
    with closing(sqlite3.connect(uri, uri=True)) as connection:
        first_computed = connection.execute(_COMPUTED).fetchone()
    if first_computed is not None:
        name = one_line(first_computed[0])[:40]
        raise InputError(f"{path}: {name!r} is no plain table, as ROS writes; record it again")


@functools.cache
def bound_decompression() -> None:
    """Makes rosbags decompress chunks within the budget, in the whole process.

    rosbags looks up the function of each compression in a dictionary of its module, whose entries
    are replaced.
    """
    import lz4.frame

    rosbag1 = importlib.import_module("rosbags.rosbag1.reader")
    mcap = importlib.import_module("rosbags.rosbag2.storage_mcap")
    rosbag1.decompressors.update(bz2=_bound(bz2.open), lz4=_bound(lz4.frame.open))
    mcap.DECOMPRESSORS.update(lz4=_bound(lz4.frame.open), zstd=_bound(mcap.zstd.open))


def _bound(open_stream: Callable[[BytesIO], IO[bytes]]) -> Callable[..., bytes]:
    """Returns a function that decompresses a chunk, as rosbags calls it, within the budget.

    Args:
        open_stream: Function of a compressed stream that returns the decompressed one.
    """

    def decompress(data: bytes, claimed: int = _CHUNK_BYTES) -> bytes:
        """Returns the content of a chunk; ValueError if it is larger than the budget or claimed.

        Args:
            data: Compressed bytes.
            claimed: Size in bytes of the content that the chunk claims, which MCAP states.
        """
        limit = min(_CHUNK_BYTES, max_file_bytes(), claimed)
        with open_stream(BytesIO(data)) as stream:
            content = stream.read(limit + 1)
        if len(content) > limit:
            raise ValueError(f"a chunk of {len(data):,} bytes holds more than {limit:,}")
        return content

    return decompress
