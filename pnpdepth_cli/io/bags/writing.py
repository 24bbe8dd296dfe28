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
    """Its fields by name, nested as in the message's type; what is left out is zero or empty."""


def write_mcap(folder: Path, outgoing: Iterable[OutgoingMessage]) -> None:
    """Writes a new folder with NAME.mcap and metadata.yaml, as `ros2 bag record` does.

    Args:
        folder: The folder, which does not exist yet.
        outgoing: Messages, in the order in which they are logged.

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
                # A topic is announced with its first message.
                if topic not in connections:
                    connections[topic] = writer.add_connection(topic, kind, typestore=store)
                data = store.serialize_cdr(_message(store, kind, fields), kind)
                writer.write(connections[topic], time_ns, data)
    except OSError as error:
        raise cannot_write(folder, error) from error


def _message(store: Typestore, kind: str, fields: Mapping[str, Any]) -> Message:
    """A message of this type; a field that is left out is zero or empty.

    Args:
        store: The message types.
        kind: Name of the message's type.
        fields: Fields of the message by name; those that are messages are mappings themselves.
    """
    from rosbags.interfaces import Nodetype

    values: dict[str, Any] = {}
    # rosbags describes a field as (kind of its type, the type). It is (NAME, type of a message),
    # (BASE, (type of a number or text, …)), or an array: (…, (description of an element, length)).
    definitions: Any = store.fielddefs[kind][1]
    for name, (node, detail) in definitions:
        value = fields.get(name)
        if node is Nodetype.NAME:
            values[name] = _message(store, detail, value or {})
        elif node is Nodetype.BASE:
            zero = "" if detail[0] == "string" else 0
            values[name] = zero if value is None else value
        elif detail[0][0] is Nodetype.NAME:
            values[name] = [_message(store, detail[0][1], element) for element in value or ()]
        else:
            values[name] = np.zeros(detail[1]) if value is None else value
    return store.types[kind](**values)
