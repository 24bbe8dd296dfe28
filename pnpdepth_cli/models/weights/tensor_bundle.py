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
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from pnpdepth_cli.errors import CheckpointError
from pnpdepth_cli.models.weights.file_size import size_problem
from pnpdepth_cli.models.weights.pickle_reader import READ_ERRORS, BrokenFileError, brief

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
_MAX_NAME = 1_000  # bytes of a variable's name
_MAX_AXES = 64


@dataclass(frozen=True, kw_only=True)
class _Variable:
    """Where the values of one variable lie."""

    dtype: int
    """TensorFlow's number of the type."""
    shape: tuple[int, ...]
    """Sides."""
    shard: int
    """Number of the file of values."""
    offset: int
    """Bytes from the beginning of that file."""
    size: int
    """Bytes."""


def read_tensor_bundle(index: Path) -> dict[str, Tensor]:
    """Returns the variables by name, "layer/weights" as "layer.weights".

    Args:
        index: PREFIX.index; the files of values lie beside it.

    Raises:
        CheckpointError: A file is missing or broken.
    """
    try:
        return _Bundle(index).read()
    except (BrokenFileError, OSError, *READ_ERRORS) as error:
        reason = brief(error)
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
        self._variables = {name.decode(): _variable(entry) for name, entry in table.items()}
        self._contents: dict[int, bytes] = {}

    def read(self) -> dict[str, Tensor]:
        """Every variable but text."""
        tensors: dict[str, Tensor] = {}
        left = 0
        for name, variable in self._variables.items():
            if variable.dtype == _TEXT:
                continue
            if variable.shard not in self._contents:
                self._contents[variable.shard] = self._content(variable.shard)
                left += len(self._contents[variable.shard])
            left -= variable.size
            if left < 0:
                raise BrokenFileError("its variables are larger than its files")
            tensors[name.replace("/", ".")] = _tensor(
                name, variable, self._contents[variable.shard]
            )
        return tensors

    def _content(self, shard: int) -> bytes:
        file = f"{self._prefix.name}.data-{shard:05d}-of-{self._shards:05d}"
        path = self._prefix.with_name(file)
        if not path.is_file():
            raise BrokenFileError(f"{file} is not beside the index")
        if problem := size_problem(path):
            raise BrokenFileError(f"{file} {problem}")
        return path.read_bytes()


def _tensor(name: str, variable: _Variable, content: bytes) -> Tensor:
    dtype = _TYPES.get(variable.dtype)
    if dtype is None:
        raise BrokenFileError(f"{name} is of TensorFlow's type {variable.dtype}, not of numbers")
    count = math.prod(variable.shape)
    if count * dtype.itemsize != variable.size or variable.offset + variable.size > len(content):
        raise BrokenFileError(
            f"{name} of shape {variable.shape} goes beyond its {variable.size} bytes"
        )
    part = bytearray(content[variable.offset : variable.offset + variable.size])
    flat = torch.frombuffer(part, dtype=dtype) if part else torch.empty(0, dtype=dtype)
    return flat.reshape(variable.shape)


def _variable(entry: bytes) -> _Variable:
    fields = dict(_fields(entry))
    if 7 in fields:
        raise BrokenFileError("a variable is in slices")
    shape = fields.get(2, b"")
    sides = list(_fields(shape)) if isinstance(shape, bytes) else []
    if len(sides) > _MAX_AXES:
        raise BrokenFileError(f"a variable of {len(sides)} axes")
    return _Variable(
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
        raise BrokenFileError("a size is not a number")
    return value


# ------------------------------------------------------------------ the table


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
