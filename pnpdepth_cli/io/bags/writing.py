"""Bags of ROS 2, written as MCAP with the released message types."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np

from pnpdepth_cli.errors import UsageError
from pnpdepth_cli.io.atomic import cannot_write
from pnpdepth_cli.io.bags import Message, message_types

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

_VERSION: Literal[9] = 9
"""Version of metadata.yaml that ROS 2 Jazzy writes, and that older ones read."""


class OutgoingMessage(NamedTuple):
    """A message to write."""

    topic: str
    kind: str
    """Name of its type, such as sensor_msgs/msg/Image."""
    time_ns: int
    """Nanoseconds at which it is logged."""
    fields: Mapping[str, Any]
    """Its fields, nested; what is left out is zero."""


def write_mcap(folder: Path, outgoing: Iterable[OutgoingMessage]) -> None:
    """Writes a new folder with NAME.mcap and metadata.yaml, as `ros2 bag record` does.

    Raises:
        UsageError: rosbags is not installed.
        OutputError: The folder cannot be written.
    """
    try:
        from rosbags.rosbag2 import StoragePlugin, Writer
    except ImportError:
        raise UsageError("writing MCAP needs rosbags: pip install 'pnpdepth[ros]'") from None
    store = message_types(ros1=False)
    try:
        with Writer(folder, version=_VERSION, storage_plugin=StoragePlugin.MCAP) as writer:
            connections = dict[str, Any]()
            for topic, kind, time_ns, fields in outgoing:
                if topic not in connections:
                    connections[topic] = writer.add_connection(topic, kind, typestore=store)
                data = store.serialize_cdr(_message(store, kind, fields), kind)
                writer.write(connections[topic], time_ns, data)
    except OSError as error:
        raise cannot_write(folder, error) from error


def _message(store: Typestore, kind: str, given: Mapping[str, Any]) -> Message:
    """A message of nested fields; what is not given is zero."""
    from rosbags.interfaces import Nodetype

    values: dict[str, Any] = {}
    fields: Any = store.fielddefs[kind][1]  # nested pairs, which rosbags' types do not tell apart
    for name, (node, of) in fields:
        value = given.get(name)
        if node is Nodetype.NAME:
            values[name] = _message(store, of, value or {})
        elif node is Nodetype.BASE:
            values[name] = ("" if of[0] == "string" else 0) if value is None else value
        elif of[0][0] is Nodetype.NAME:
            values[name] = [_message(store, of[0][1], element) for element in value or ()]
        else:
            values[name] = np.zeros(of[1]) if value is None else value
    return store.types[kind](**values)
