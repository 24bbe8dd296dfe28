"""Limits of bags, because rosbags decompresses whatever a chunk holds and runs what SQLite stores.

A chunk of a few kilobytes can hold gigabytes. An SQLite schema can hold views and generated
columns, which are computed when they are read.
"""

from __future__ import annotations

import bz2
import functools
import importlib
import sqlite3
from collections.abc import Callable, Mapping
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO

from pnpdepth_cli.budget import budget
from pnpdepth_cli.errors import FileFormatError
from pnpdepth_cli.io.file_bytes import one_line, read_bytes, size_of_regular_file
from pnpdepth_cli.io.yaml_file import parse_yaml

_METADATA, _INFORMATION = "metadata.yaml", "rosbag2_bagfile_information"
_CHUNK_BYTES = 1 << 28
"""Chunks are closed at 768 KiB by default, and a message of a sensor is far below this."""

_COMPUTED = """
    SELECT name FROM sqlite_master
    WHERE type NOT IN ('table', 'index') OR sql LIKE 'CREATE VIRTUAL%'
    UNION ALL
    SELECT m.name FROM sqlite_master m JOIN pragma_table_xinfo(m.name) x
    WHERE m.type = 'table' AND x.hidden
"""
"""Views, triggers, virtual tables, and tables with generated columns."""


def check_bag(path: Path) -> None:
    """Raises FileFormatError if a bag is compressed as a whole, or its database computes values.

    Args:
        path: A file, or a folder with metadata.yaml.
    """
    if path.is_dir():
        _check_metadata(path / _METADATA)
    files = sorted(path.glob("*.db3")) if path.is_dir() else [path]
    for file in files:
        size_of_regular_file(file)
        if file.suffix.lower() == ".db3":
            _check_database(file)


def _check_metadata(path: Path) -> None:
    content = parse_yaml(path, read_bytes(path).decode("utf-8", "replace"))
    information = content.get(_INFORMATION) if isinstance(content, Mapping) else None
    if not isinstance(information, Mapping):
        raise FileFormatError(f"{path} is not the metadata of a bag; repair it: ros2 bag reindex")
    mode = str(information.get("compression_mode") or "none").lower()
    if mode != "none":
        raise FileFormatError(
            f"{path}: bags of compression_mode {one_line(mode)[:20]!r} are not read; convert it"
            " with `ros2 bag convert`, to MCAP with compressed chunks if it must be small"
        )


def _check_database(path: Path) -> None:
    connection = sqlite3.connect(f"{path.absolute().as_uri()}?immutable=1", uri=True)
    try:
        computed = connection.execute(_COMPUTED).fetchone()
    finally:
        connection.close()
    if computed is not None:
        raise FileFormatError(
            f"{path}: {one_line(computed[0])[:40]!r} is no plain table, so this database was not"
            " recorded by ROS; record the bag again"
        )


@functools.cache
def bound_decompression() -> None:
    """Makes rosbags decompress chunks within `budget()`, in the whole process."""
    import lz4.frame

    rosbag1: Any = importlib.import_module("rosbags.rosbag1.reader")
    mcap: Any = importlib.import_module("rosbags.rosbag2.storage_mcap")
    rosbag1.decompressors.update(bz2=_bounded(bz2.open), lz4=_bounded(lz4.frame.open))
    mcap.DECOMPRESSORS.update(lz4=_bounded(lz4.frame.open), zstd=_bounded(mcap.zstd.open))


def _bounded(open_stream: Callable[..., Any]) -> Callable[..., bytes]:
    """Returns a function of compressed bytes and, for MCAP, the size that the chunk claims."""

    def decompress(data: bytes, claimed: int | None = None) -> bytes:
        limit = min(_CHUNK_BYTES, budget().max_file_bytes)
        if claimed is not None:
            limit = min(limit, claimed)
        stream: BinaryIO
        with open_stream(BytesIO(data)) as stream:
            content = stream.read(limit + 1)
        if len(content) > limit:
            raise ValueError(f"a chunk of {len(data):,} bytes holds more than {limit:,}")
        return content

    return decompress
