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

_FOOTER, _MAGIC = 48, 0xDB4775248B80FB57
_TYPES = {
    1: torch.float32, 2: torch.float64, 3: torch.int32, 4: torch.uint8, 5: torch.int16,
    6: torch.int8, 9: torch.int64, 10: torch.bool, 14: torch.bfloat16, 19: torch.float16,
}  # fmt: skip
_TEXT = 7  # such as the graph of objects that TensorFlow 2 puts beside the variables
_MAX_NAME = 1_000  # bytes of a variable's name

# Numbers of fields in TensorFlow's tensor_bundle.proto: of the header, and of a variable's entry.
_SHARD_COUNT = 1
_IS_BIG_ENDIAN = 2
_TYPE = 1
_SHAPE = 2
_SHARD = 3
_OFFSET = 4
_SIZE = 5
_SLICES = 7

_Fields = dict[int, list[Any]]  # of a protocol buffer, by number


def read_tensor_bundle(index: Path) -> dict[str, Tensor]:
    """Returns the variables by name, "layer/weights" as "layer.weights"; text is left out.

    The files of values lie beside PREFIX.index. A broken file raises whatever its parts do.
    """
    # The table of variables, after its header.
    table = dict(_table(index.read_bytes()))
    header = _message(table.pop(b"", b""))
    if _last(header, _IS_BIG_ENDIAN) != 0:
        raise InputError("it was written on a big-endian machine")
    shards: dict[int, bytes] = {}
    tensors: dict[str, Tensor] = {}
    left = 0
    for key, entry in table.items():
        name = key.decode()
        fields = _message(entry)
        if _SLICES in fields:
            raise InputError("a variable is in slices")
        if _last(fields, _TYPE) == _TEXT:
            continue
        # The file of its values, read once.
        shard = _last(fields, _SHARD)
        if shard not in shards:
            count = _last(header, _SHARD_COUNT)
            path = index.with_name(f"{index.stem}.data-{shard:05d}-of-{count:05d}")
            check_network_file(path, f"checkpoint {index}: its file")
            shards[shard] = path.read_bytes()
            left += len(shards[shard])
        # Variables claim no more than the files have.
        size = _last(fields, _SIZE)
        check_claim(f"{name} has {size:,} bytes", size, left)
        left -= size
        tensors[name.replace("/", ".")] = _tensor(name, fields, shards[shard])
    return tensors


def _tensor(name: str, fields: _Fields, content: bytes) -> Tensor:
    kind, offset, size = (_last(fields, number) for number in (_TYPE, _OFFSET, _SIZE))
    if kind not in _TYPES:
        raise InputError(f"{name} is of TensorFlow's type {kind}, not of numbers")
    sides = _message(fields[_SHAPE][-1]).get(2, []) if _SHAPE in fields else []
    shape = [_last(_message(side), 1) for side in sides]
    if math.prod(shape) * _TYPES[kind].itemsize != size or offset + size > len(content):
        raise InputError(f"{name} of shape {str(shape)[:80]} goes beyond its {size} bytes")
    if not size:
        return torch.empty(shape, dtype=_TYPES[kind])
    part = bytearray(content[offset : offset + size])
    return torch.frombuffer(part, dtype=_TYPES[kind]).reshape(shape)


def _table(data: bytes) -> Iterator[tuple[bytes, bytes]]:
    """Keys and values of all blocks."""
    if len(data) < _FOOTER or struct.unpack("<Q", data[-8:])[0] != _MAGIC:
        raise InputError("it does not end as an index does")
    _, at = _varint(data, len(data) - _FOOTER)  # the block of metadata comes first; it is empty
    _, at = _varint(data, at)
    behind_last = 0
    for _, handle in _block(data, data[at:]):
        offset, size_at = _varint(handle, 0)
        if offset < behind_last:
            raise InputError("its blocks overlap")
        behind_last = offset + max(1, _varint(handle, size_at)[0])
        yield from _block(data, handle)


def _block(data: bytes, handle: bytes) -> Iterator[tuple[bytes, bytes]]:
    """Keys and values of the block at (offset, size); each key continues the one before."""
    offset, at = _varint(handle, 0)
    size, _ = _varint(handle, at)
    if offset + size >= len(data) or size < 4:
        raise InputError("a block goes beyond its end")
    if data[offset + size] != 0:
        raise InputError("its index is compressed, which TensorFlow does not do")
    (restarts,) = struct.unpack_from("<I", data, offset + size - 4)
    at = offset
    end = offset + size - 4 * (restarts + 1)
    key = b""
    while at < end:
        shared, at = _varint(data, at)
        fresh, at = _varint(data, at)
        length, at = _varint(data, at)
        if at + fresh + length > end or shared > len(key):
            raise InputError("an entry goes beyond its block")
        if shared + fresh > _MAX_NAME:
            raise InputError(f"it has a name of {shared + fresh:,} bytes")
        key = key[:shared] + data[at : at + fresh]
        yield key, data[at + fresh : at + fresh + length]
        at += fresh + length


def _message(data: bytes) -> _Fields:
    fields: _Fields = {}
    at = 0
    while at < len(data):
        tag, at = _varint(data, at)
        match tag & 7:
            case 0:
                value, at = _varint(data, at)
                fields.setdefault(tag >> 3, []).append(value)
            case 2:
                length, at = _varint(data, at)
                fields.setdefault(tag >> 3, []).append(data[at : at + length])
                at += length
            case 5:  # a checksum
                at += 4
            case _:
                raise InputError("an entry is not a protocol buffer")
    return fields


def _last(fields: _Fields, number: int) -> int:
    """A number; 0 if it is absent."""
    value = fields.get(number, [0])[-1]
    if not isinstance(value, int) or value >= 1 << 63:
        raise InputError("a size is not a number")
    return value


def _varint(data: bytes, at: int) -> tuple[int, int]:
    """The number that begins here, seven bits a byte, and where it ends."""
    value = 0
    for shift in range(0, 70, 7):
        value |= (data[at] & 127) << shift
        at += 1
        if data[at - 1] < 128:
            return value, at
    raise InputError("a number without end")
