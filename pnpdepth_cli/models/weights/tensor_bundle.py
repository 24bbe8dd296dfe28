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

import torch
from torch import Tensor

from pnpdepth_cli.budget import size_problem
from pnpdepth_cli.errors import CheckpointError
from pnpdepth_cli.models.weights.pickle_reader import MAX_AXES, READ_ERRORS, BrokenFileError, brief

SUFFIX = ".index"

_FOOTER, _MAGIC = 48, 0xDB4775248B80FB57
_TYPES = {
    1: torch.float32, 2: torch.float64, 3: torch.int32, 4: torch.uint8, 5: torch.int16,
    6: torch.int8, 9: torch.int64, 10: torch.bool, 14: torch.bfloat16, 19: torch.float16,
}  # fmt: skip
_TEXT = 7  # such as the graph of objects that TensorFlow 2 puts beside the variables
_MAX_NAME = 1_000  # bytes of a variable's name

_Fields = dict[int, int | bytes]
"""The fields of a protocol buffer by number."""


def read_tensor_bundle(index: Path) -> dict[str, Tensor]:
    """Returns the variables by name, "layer/weights" as "layer.weights"; text is left out.

    Args:
        index: PREFIX.index; the files of values lie beside it.

    Raises:
        CheckpointError: A file is missing or broken.
    """
    try:
        return _read(index)
    except (BrokenFileError, OSError, *READ_ERRORS) as error:
        reason = brief(error)
    raise CheckpointError(
        f"checkpoint {index} cannot be read as a TensorFlow checkpoint ({reason})"
    )


def _read(index: Path) -> dict[str, Tensor]:
    table = dict(_table(index.read_bytes()))
    header = dict(_fields(table.pop(b"", b"")))
    if header.get(2, 0) != 0:
        raise BrokenFileError("it was written on a big-endian machine")
    shards: dict[int, bytes] = {}
    tensors: dict[str, Tensor] = {}
    left = 0
    for key, entry in table.items():
        name, fields = key.decode(), dict(_fields(entry))
        if 7 in fields:
            raise BrokenFileError("a variable is in slices")
        if fields.get(1) == _TEXT:
            continue
        shard, size = _number(fields, 3), _number(fields, 5)
        if shard not in shards:
            shards[shard] = _values(index, f"{shard:05d}-of-{_number(header, 1):05d}")
            left += len(shards[shard])
        left -= size
        if left < 0:
            raise BrokenFileError("its variables are larger than its files")
        tensors[name.replace("/", ".")] = _tensor(name, fields, shards[shard])
    return tensors


def _values(index: Path, shard: str) -> bytes:
    path = index.with_name(f"{index.stem}.data-{shard}")
    if not path.is_file():
        raise BrokenFileError(f"{path.name} is not beside the index")
    if problem := size_problem(path):
        raise BrokenFileError(f"{path.name} {problem}")
    return path.read_bytes()


def _tensor(name: str, fields: _Fields, content: bytes) -> Tensor:
    kind = _number(fields, 1)
    if kind not in _TYPES:
        raise BrokenFileError(f"{name} is of TensorFlow's type {kind}, not of numbers")
    dtype = _TYPES[kind]
    shape = fields.get(2, b"")
    sides = [*_fields(shape)] if isinstance(shape, bytes) else []
    if len(sides) > MAX_AXES:
        raise BrokenFileError(f"a variable of {len(sides)} axes")
    lengths = [
        _number(dict(_fields(side)), 1)
        for number, side in sides
        if number == 2 and isinstance(side, bytes)
    ]
    offset, size = _number(fields, 4), _number(fields, 5)
    if math.prod(lengths) * dtype.itemsize != size or offset + size > len(content):
        raise BrokenFileError(f"{name} of shape {tuple(lengths)} goes beyond its {size} bytes")
    part = bytearray(content[offset : offset + size])
    flat = torch.frombuffer(part, dtype=dtype) if part else torch.empty(0, dtype=dtype)
    return flat.reshape(lengths)


def _number(fields: _Fields, number: int) -> int:
    value = fields.get(number, 0)
    if not isinstance(value, int) or value >= 1 << 63:
        raise BrokenFileError("a size is not a number")
    return value


def _table(data: bytes) -> Iterator[tuple[bytes, bytes]]:
    """Keys and values of all blocks."""
    if len(data) < _FOOTER or struct.unpack("<Q", data[-8:])[0] != _MAGIC:
        raise BrokenFileError("it does not end as an index does")
    _, at = _varint(data, len(data) - _FOOTER)  # the block of metadata comes first; it is empty
    _, at = _varint(data, at)
    behind_last = 0
    for _, handle in _block(data, data[at:]):
        offset, size_at = _varint(handle, 0)
        if offset < behind_last:
            raise BrokenFileError("its blocks overlap")
        behind_last = offset + max(1, _varint(handle, size_at)[0])
        yield from _block(data, handle)


def _block(data: bytes, handle: bytes) -> Iterator[tuple[bytes, bytes]]:
    """Keys and values of the block at (offset, size); each key continues the one before."""
    offset, at = _varint(handle, 0)
    size, _ = _varint(handle, at)
    if offset + size >= len(data) or size < 4:
        raise BrokenFileError("a block goes beyond its end")
    if data[offset + size] != 0:
        raise BrokenFileError("its index is compressed, which TensorFlow does not do")
    (restarts,) = struct.unpack_from("<I", data, offset + size - 4)
    at, end = offset, offset + size - 4 * (restarts + 1)
    key = b""
    while at < end:
        shared, at = _varint(data, at)
        fresh, at = _varint(data, at)
        length, at = _varint(data, at)
        if at + fresh + length > end or shared > len(key):
            raise BrokenFileError("an entry goes beyond its block")
        if shared + fresh > _MAX_NAME:
            raise BrokenFileError(f"it has a name of {shared + fresh:,} bytes")
        key = key[:shared] + data[at : at + fresh]
        yield key, data[at + fresh : at + fresh + length]
        at += fresh + length


def _fields(message: int | bytes) -> Iterator[tuple[int, int | bytes]]:
    """Numbers and values of a protocol buffer's fields."""
    assert isinstance(message, bytes)
    at = 0
    while at < len(message):
        tag, at = _varint(message, at)
        number, kind = tag >> 3, tag & 7
        if kind == 0:
            value, at = _varint(message, at)
            yield number, value
        elif kind == 2:
            length, at = _varint(message, at)
            yield number, message[at : at + length]
            at += length
        elif kind in (1, 5):
            at += 8 if kind == 1 else 4  # checksums
        else:
            raise BrokenFileError("an entry is not a protocol buffer")


def _varint(data: bytes, at: int) -> tuple[int, int]:
    """The number that begins here, seven bits a byte, and where it ends."""
    value = 0
    for shift in range(0, 70, 7):
        byte = data[at]
        at += 1
        value |= (byte & 127) << shift
        if byte < 128:
            return value, at
    raise BrokenFileError("a number without end")
