"""The variables of a TensorFlow checkpoint, without TensorFlow.

A checkpoint is PREFIX.index, a sorted table (LevelDB's) from a variable's name to its type, shape
and place, and PREFIX.data-00000-of-00001 or more, where the values lie one after the other. There
is nothing in them to run. Memory stays bounded by the size of the files.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from pnpdepth_cli.errors import CheckpointError
from pnpdepth_cli.models.weights.pickle_reader import BrokenFileError

SUFFIX = ".index"

_FOOTER, _MAGIC = 48, 0xDB4775248B80FB57
_TYPES = {
    1: torch.float32,
    2: torch.float64,
    3: torch.int32,
    4: torch.uint8,
    5: torch.int16,
    6: torch.int8,
    9: torch.int64,
    10: torch.bool,
    14: torch.bfloat16,
    19: torch.float16,
}
_TEXT = 7  # such as the graph of objects that TensorFlow 2 puts beside the variables


@dataclass(frozen=True, kw_only=True)
class _Place:
    """Where the values of one variable lie."""

    dtype: int
    shape: tuple[int, ...]
    shard: int
    offset: int
    size: int


def read_tensor_bundle(index: Path) -> dict[str, Tensor]:
    """The variables by name, "layer/weights" as "layer.weights". CheckpointError if that fails."""
    try:
        return _Bundle(index).read()
    except BrokenFileError as error:
        reason: object = error
    except (OSError, IndexError, RuntimeError, struct.error, UnicodeDecodeError) as error:
        reason = f"{type(error).__name__}: {' '.join(str(error).split())[:120]}"
    raise CheckpointError(
        f"checkpoint {index} cannot be read as a TensorFlow checkpoint ({reason})"
    )


class _Bundle:
    """An index and the files of values beside it."""

    def __init__(self, index: Path) -> None:
        self._prefix = index.with_suffix("")
        table = dict(_table(index.read_bytes()))
        header = dict(_fields(table.pop(b"", b"")))
        if header.get(2, 0) != 0:
            raise BrokenFileError("it was written on a big-endian machine")
        self._shards = _number(header.get(1, 0))
        self._places = {name.decode(): _place(entry) for name, entry in table.items()}
        self._contents: dict[int, bytes] = {}

    def read(self) -> dict[str, Tensor]:
        """Every variable but text."""
        found: dict[str, Tensor] = {}
        left = 0
        for name, place in self._places.items():
            if place.dtype == _TEXT:
                continue
            if place.shard not in self._contents:
                self._contents[place.shard] = self._content(place.shard)
                left += len(self._contents[place.shard])
            left -= place.size
            if left < 0:
                raise BrokenFileError("its variables are larger than its files")
            found[name.replace("/", ".")] = _tensor(name, place, self._contents[place.shard])
        return found

    def _content(self, shard: int) -> bytes:
        file = f"{self._prefix.name}.data-{shard:05d}-of-{self._shards:05d}"
        path = self._prefix.with_name(file)
        if not path.is_file():
            raise BrokenFileError(f"{file} is not beside it")
        return path.read_bytes()


def _tensor(name: str, place: _Place, content: bytes) -> Tensor:
    dtype = _TYPES.get(place.dtype)
    if dtype is None:
        raise BrokenFileError(f"{name} is of TensorFlow's type {place.dtype}, not of numbers")
    count = math.prod(place.shape)
    if count * dtype.itemsize != place.size or place.offset + place.size > len(content):
        raise BrokenFileError(f"{name} of shape {place.shape} goes beyond its {place.size} bytes")
    part = bytearray(content[place.offset : place.offset + place.size])
    flat = torch.frombuffer(part, dtype=dtype) if part else torch.empty(0, dtype=dtype)
    return flat.reshape(place.shape)


def _place(entry: bytes) -> _Place:
    fields = dict(_fields(entry))
    if 7 in fields:
        raise BrokenFileError("a variable is in slices")
    shape = fields.get(2, b"")
    sides = _fields(shape) if isinstance(shape, bytes) else ()
    return _Place(
        dtype=_number(fields.get(1, 0)),
        shape=tuple(
            _number(dict(_fields(side)).get(1, 0))
            for number, side in sides
            if number == 2 and isinstance(side, bytes)
        ),
        shard=_number(fields.get(3, 0)),
        offset=_number(fields.get(4, 0)),
        size=_number(fields.get(5, 0)),
    )


def _number(value: int | bytes) -> int:
    if not isinstance(value, int) or value >= 1 << 63:
        raise BrokenFileError("a size that is none")
    return value


# ------------------------------------------------------------------ the table


def _table(data: bytes) -> Iterator[tuple[bytes, bytes]]:
    """Keys and values of all blocks."""
    if len(data) < _FOOTER or struct.unpack("<Q", data[-8:])[0] != _MAGIC:
        raise BrokenFileError("it does not end as an index does")
    _, at = _varint(data, len(data) - _FOOTER)  # the block of metadata comes first; it is empty
    _, at = _varint(data, at)
    for _, handle in _block(data, data[at:]):
        yield from _block(data, handle)


def _block(data: bytes, handle: bytes) -> Iterator[tuple[bytes, bytes]]:
    """Keys and values of the block at (offset, size); each key goes on from the one before."""
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
        key = key[:shared] + data[at : at + fresh]
        at += fresh
        yield key, data[at : at + length]
        at += length


def _fields(message: bytes) -> Iterator[tuple[int, int | bytes]]:
    """Numbers and values of a protocol buffer's fields."""
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
            raise BrokenFileError("an entry that is no protocol buffer")


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
