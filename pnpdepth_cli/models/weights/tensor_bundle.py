"""The variables of a TensorFlow checkpoint, without TensorFlow.

A checkpoint is PREFIX.index, a sorted table (LevelDB's) from a variable's name to its type, shape
and offset, and PREFIX.data-00000-of-00001 or more, where the values lie one after the other. There
is nothing in them to run. Memory stays bounded by the size of the files: names are short, no two
blocks of the table overlap, and the variables are no larger than the files.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from pnpdepth_cli.budget import check_claim, check_network_file
from pnpdepth_cli.errors import InputError

_FOOTER = 48
"""Bytes at the end of an index: where its blocks of metadata and of handles lie, and the magic."""
_MAGIC = 0xDB4775248B80FB57
"""Number in the last 8 bytes of an index."""
_TYPES = {
    1: torch.float32, 2: torch.float64, 3: torch.int32, 4: torch.uint8, 5: torch.int16,
    6: torch.int8, 9: torch.int64, 10: torch.bool, 14: torch.bfloat16, 19: torch.float16,
}  # fmt: skip
"""Types of elements by TensorFlow's number."""
_TEXT = 7
"""The type of text, such as the graph of objects that TensorFlow 2 puts beside the variables."""
_MAX_NAME = 1_000
"""Bytes of a variable's name."""
_MAX_SHAPE = 80
"""Characters of a variable's shape that a message shows."""

# Numbers of fields in TensorFlow's tensor_bundle.proto and tensor_shape.proto.
# Of the header:
_SHARD_COUNT = 1
_IS_BIG_ENDIAN = 2
# Of a variable's entry:
_TYPE = 1
_SHAPE = 2
_SHARD = 3
_OFFSET = 4
_SIZE = 5
_SLICES = 7
# Of a shape, and of each of its sides:
_SIDES = 2
_SIDE_LENGTH = 1

# Kinds of fields in a protocol buffer, the lowest three bits before each field.
_VARINT = 0
_LENGTH_AND_BYTES = 2
_FOUR_BYTES = 5

_Fields = dict[int, list[Any]]
"""Values of a protocol buffer's fields, int or bytes, in their order by the field's number."""


def read_tensor_bundle(index: Path) -> dict[str, Tensor]:
    """Returns the variables by name, "layer/weights" as "layer.weights"; text is left out.

    Args:
        index: File PREFIX.index; the files of values lie beside it.

    Raises:
        Exception: A file is missing or broken; ModelError, or one of `CONTENT_ERRORS`.
    """
    # The table of variables, whose entry without a name is the header.
    table = dict(_table_entries(index.read_bytes()))
    header = _fields_of(table.pop(b"", b""))
    if _last_number(header, _IS_BIG_ENDIAN) != 0:
        raise InputError("it was written on a big-endian machine")
    shards: dict[int, bytes] = {}
    tensors: dict[str, Tensor] = {}
    bytes_left = 0
    for key, entry in table.items():
        name = key.decode()
        fields = _fields_of(entry)
        if _SLICES in fields:
            raise InputError("a variable is in slices")
        if _last_number(fields, _TYPE) == _TEXT:
            continue
        # The file of its values, read once.
        shard = _last_number(fields, _SHARD)
        if shard not in shards:
            count = _last_number(header, _SHARD_COUNT)
            path = index.with_name(f"{index.stem}.data-{shard:05d}-of-{count:05d}")
            check_network_file(path, f"checkpoint {index}: its file")
            shards[shard] = path.read_bytes()
            bytes_left += len(shards[shard])
        # Variables claim no more than the files have.
        size = _last_number(fields, _SIZE)
        check_claim(f"{name} has {size:,} bytes", size, bytes_left)
        bytes_left -= size
        tensors[name.replace("/", ".")] = _tensor(name, fields, shards[shard])
    return tensors


def _tensor(name: str, fields: _Fields, content: bytes) -> Tensor:
    """Returns a variable.

    Args:
        name: Name of the variable, for messages.
        fields: Fields of its entry in the table.
        content: Content of the file that its values lie in.

    Raises:
        InputError: It has a type that is not known, or goes beyond its bytes.
    """
    kind = _last_number(fields, _TYPE)
    offset = _last_number(fields, _OFFSET)
    size = _last_number(fields, _SIZE)
    if kind not in _TYPES:
        raise InputError(f"{name} is of TensorFlow's type {kind}, not of numbers")
    # The shape is a message with one for each side in it; a scalar has none.
    sides = _fields_of(fields[_SHAPE][-1]).get(_SIDES, []) if _SHAPE in fields else []
    shape = [_last_number(_fields_of(side), _SIDE_LENGTH) for side in sides]
    if math.prod(shape) * _TYPES[kind].itemsize != size or offset + size > len(content):
        raise InputError(f"{name} of shape {str(shape)[:_MAX_SHAPE]} goes beyond its {size} bytes")
    if not size:  # torch.frombuffer takes no empty buffer
        return torch.empty(shape, dtype=_TYPES[kind])
    values = bytearray(content[offset : offset + size])
    return torch.frombuffer(values, dtype=_TYPES[kind]).reshape(shape)


def _table_entries(index: bytes) -> Iterator[tuple[bytes, bytes]]:
    """Yields keys and values of all blocks of an index's table, in their order.

    Raises:
        InputError: It is no index, or its blocks overlap.
    """
    if len(index) < _FOOTER or struct.unpack("<Q", index[-8:])[0] != _MAGIC:
        raise InputError("it does not end as an index does")
    # The footer has offset and size of the block of metadata, which is empty, and then those of the
    # block whose values are handles: offset and size of each block with entries.
    _, position = _varint(index, len(index) - _FOOTER)
    _, position = _varint(index, position)
    handles = _block_entries(index, index[position:])
    last_end = 0
    for _, handle in handles:
        offset, size_position = _varint(handle, 0)
        size, _ = _varint(handle, size_position)
        if offset < last_end:
            raise InputError("its blocks overlap")
        last_end = offset + max(1, size)
        yield from _block_entries(index, handle)


def _block_entries(index: bytes, handle: bytes) -> Iterator[tuple[bytes, bytes]]:
    """Yields keys and values of one block of an index's table.

    Args:
        index: Content of the index.
        handle: Bytes that begin with the block's offset and size, two varints.

    Raises:
        InputError: The block is broken, compressed or has a name that is too long.
    """
    offset, position = _varint(handle, 0)
    size, _ = _varint(handle, position)
    if offset + size >= len(index) or size < 4:
        raise InputError("a block goes beyond its end")
    # Behind the block is a byte for its compression.
    if index[offset + size] != 0:
        raise InputError("its index is compressed, which TensorFlow does not do")
    # The block ends with places where keys restart, four bytes each, and their number.
    (restart_count,) = struct.unpack_from("<I", index, offset + size - 4)
    position = offset
    end = offset + size - 4 * (restart_count + 1)
    key = b""
    while position < end:
        # A key begins as the one before does; only the rest of it is stored.
        shared, position = _varint(index, position)
        fresh, position = _varint(index, position)
        length, position = _varint(index, position)
        if position + fresh + length > end or shared > len(key):
            raise InputError("an entry goes beyond its block")
        if shared + fresh > _MAX_NAME:
            raise InputError(f"it has a name of {shared + fresh:,} bytes")
        value_position = position + fresh
        key = key[:shared] + index[position:value_position]
        position = value_position + length
        yield key, index[value_position:position]


def _fields_of(message: bytes) -> _Fields:
    """Returns a protocol buffer's fields by number, each a list of int or bytes, as it may recur.

    Fields of four bytes are left out.

    Raises:
        InputError: The message is no protocol buffer.
    """
    fields: _Fields = {}
    position = 0
    while position < len(message):
        # A field begins with its number, and in the lowest three bits its kind.
        tag, position = _varint(message, position)
        number = tag >> 3
        kind = tag & 7
        if kind == _VARINT:
            value, position = _varint(message, position)
            fields.setdefault(number, []).append(value)
        elif kind == _LENGTH_AND_BYTES:
            length, position = _varint(message, position)
            fields.setdefault(number, []).append(message[position : position + length])
            position += length
        elif kind == _FOUR_BYTES:  # a checksum
            position += 4
        else:
            raise InputError("an entry is not a protocol buffer")
    return fields


def _last_number(fields: _Fields, number: int) -> int:
    """Returns the last value of a field of this number, a number itself; 0 if it is absent.

    Raises:
        InputError: The value is no number below 2⁶³.
    """
    value = fields.get(number, [0])[-1]
    if not isinstance(value, int) or value >= 1 << 63:
        raise InputError("a size is not a number")
    return value


def _varint(content: bytes, position: int) -> tuple[int, int]:
    """Returns the varint at a position, and the position behind it.

    A varint is a whole number, seven bits a byte, the lowest first; the eighth bit of its last byte
    is 0.

    Raises:
        InputError: It has more than ten bytes.
    """
    value = 0
    for shift in range(0, 70, 7):
        byte = content[position]
        position += 1
        value |= (byte & 127) << shift
        if byte < 128:
            return value, position
    raise InputError("a number without end")
