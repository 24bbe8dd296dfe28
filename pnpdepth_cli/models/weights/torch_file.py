"""Tensors and plain containers of a torch file; nothing in the file is run.

Both layouts of torch.save are read, the zip archive (torch ≥ 1.6) and the older row of pickles.
Memory stays bounded by the size of the file: compressed archives, and storages and tensors larger
than what is stored, are refused, and tensors of one storage share it.
"""

from __future__ import annotations

import io
import itertools
import zipfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, TypeGuard

import torch
from torch import Tensor

from pnpdepth_cli.errors import CheckpointError
from pnpdepth_cli.models.weights.pickle_reader import (
    MAX_NAME,
    READ_ERRORS,
    BrokenFileError,
    Name,
    PickleReader,
    StandIn,
    brief,
)

_MAGIC = 0x1950A86A20F9469CFC6C
_MAX_DEPTH = 100
_MAX_MODULES = 100_000
_DTYPES = {
    "FloatStorage": torch.float32,
    "DoubleStorage": torch.float64,
    "HalfStorage": torch.float16,
    "BFloat16Storage": torch.bfloat16,
    "LongStorage": torch.int64,
    "IntStorage": torch.int32,
    "ShortStorage": torch.int16,
    "CharStorage": torch.int8,
    "ByteStorage": torch.uint8,
    "BoolStorage": torch.bool,
    "ComplexFloatStorage": torch.complex64,
    "ComplexDoubleStorage": torch.complex128,
    "UntypedStorage": torch.uint8,
}


@dataclass(frozen=True, kw_only=True)
class TensorFile:
    """What a torch file holds: tensors in plain containers, and a `StandIn` for all else.

    named: the functions and classes that its pickle names, none of which was run.
    """

    content: Any
    named: tuple[str, ...]
    has_stand_ins: bool


def read_tensor_file(path: Path) -> TensorFile:
    """Returns the content of a torch file.

    Raises:
        CheckpointError: The file is broken, or is not one of torch.
    """
    try:
        with path.open("rb") as file:
            return read_tensors(file)
    except (BrokenFileError, zipfile.BadZipFile, OSError, *READ_ERRORS) as error:
        reason = brief(error)
    raise CheckpointError(f"checkpoint {path} cannot be read as a torch file ({reason})")


def read_tensors(file: IO[bytes]) -> TensorFile:
    """Returns the content of an open torch file.

    Raises:
        BrokenFileError: The file is broken, or is not one of torch.
        Exception: Another of READ_ERRORS, BadZipFile or OSError.
    """
    size = file.seek(0, io.SEEK_END)
    is_archive = zipfile.is_zipfile(file)
    file.seek(0)
    return _read_archive(file, size) if is_archive else _read_row_of_pickles(file, size)


def is_module(value: Any) -> TypeGuard[StandIn]:
    """Returns True for a stand-in of a torch module."""
    return isinstance(value, StandIn) and "_parameters" in value.state


def module_state(module: StandIn) -> dict[str, Tensor]:
    """Returns the state dict of a whole pickled module, as the module itself would have given it.

    Raises:
        CheckpointError: Its modules contain each other.
    """
    return dict(_walk(module, "", itertools.count()))


def _walk(module: StandIn, prefix: str, visited: Iterator[int]) -> Iterator[tuple[str, Tensor]]:
    endless = next(visited) > _MAX_MODULES or prefix.count(".") > _MAX_DEPTH
    if endless or len(prefix) > MAX_NAME:
        raise CheckpointError("the checkpoint's modules contain each other without end")
    fleeting = module.state.get("_non_persistent_buffers_set")
    fleeting = fleeting.arguments[0] if isinstance(fleeting, StandIn) else None
    # Not a set, in which other elements may take for ever to hash.
    left_out = [n for n in fleeting if isinstance(n, str)] if isinstance(fleeting, list) else []
    for kind in ("_parameters", "_buffers", "_modules"):
        entries = module.state.get(kind)
        for name, value in entries.items() if isinstance(entries, Mapping) else ():
            if kind == "_modules" and is_module(value):
                yield from _walk(value, f"{prefix}{name}.", visited)
            elif kind != "_modules" and isinstance(value, Tensor) and name not in left_out:
                yield f"{prefix}{name}", value


def _read_archive(file: IO[bytes], size: int) -> TensorFile:
    with zipfile.ZipFile(file) as archive:
        entries = {info.filename: info for info in archive.infolist()}
        if any("/code/" in name for name in entries):
            raise BrokenFileError(
                "it is a TorchScript archive; save the state_dict() of its module instead"
            )
        if any(info.compress_type != zipfile.ZIP_STORED for info in entries.values()):
            raise BrokenFileError("it is compressed, which torch never does")
        pickles = [name for name in entries if name == "data.pkl" or name.endswith("/data.pkl")]
        if len(pickles) != 1:
            raise BrokenFileError(f"the archive has {len(pickles)} entries named data.pkl")
        if sum(info.file_size for info in entries.values()) > size:
            raise BrokenFileError("its entries are larger than the file")
        folder = pickles[0].removesuffix("data.pkl")
        order = entries.get(f"{folder}byteorder")
        if order is not None and archive.read(order).strip() == b"big":
            raise BrokenFileError("it was written on a big-endian machine")
        storages = _Storages(lambda key, _: bytearray(archive.read(entries[f"{folder}data/{key}"])))
        with archive.open(pickles[0]) as pickled:
            return _read_pickle(pickled, storages)


def _read_row_of_pickles(file: IO[bytes], size: int) -> TensorFile:
    """magic, protocol, system, content, keys of the storages; then each storage's length and bytes.

    The content comes before the storages, which are filled afterwards.
    """

    def no_storage(_: Any) -> Tensor:
        raise BrokenFileError("it begins as no torch file does")

    if PickleReader(file, no_storage).load() != _MAGIC:
        raise BrokenFileError("it begins as no torch file does")
    for _ in ("protocol", "system"):
        PickleReader(file, no_storage).load()
    promised = 0

    def room_for(key: str, count: int) -> bytearray:
        nonlocal promised
        promised += count
        if not 0 <= count <= promised <= size:
            raise BrokenFileError("its storages are larger than the file")
        return bytearray(count)

    storages = _Storages(room_for)
    content = _read_pickle(file, storages)
    keys = PickleReader(file, no_storage).load()
    plain = isinstance(keys, list) and all(isinstance(key, str | int) for key in keys)
    if not plain or {*map(str, keys)} != storages.contents.keys():
        raise BrokenFileError("its storages are not those that its pickle names")
    for key in keys:
        memory, dtype = storages.contents[str(key)], storages.dtypes[str(key)]
        count = int.from_bytes(file.read(8), "little") * dtype.itemsize
        if count != len(memory) or file.readinto(memory) != count:  # type: ignore[attr-defined]
            raise BrokenFileError(f"storage {str(key)[:20]} is shorter than it should be")
    return content


def _read_pickle(file: IO[bytes], storages: _Storages) -> TensorFile:
    reader = PickleReader(file, storages.load)
    content = reader.load()
    return TensorFile(
        content=content, named=tuple(reader.named), has_stand_ins=reader.has_stand_ins
    )


class _Storages:
    """The storages of a file, each made once, from its key and the bytes that it should have."""

    def __init__(self, make: Callable[[str, int], bytearray]) -> None:
        self._make = make
        self.contents: dict[str, bytearray] = {}
        self.dtypes: dict[str, torch.dtype] = {}

    def load(self, pid: tuple[Any, ...]) -> Tensor:
        """The storage for ("storage", type, key, location, elements, view) as a flat tensor."""
        if not isinstance(pid[2], str | int):
            raise BrokenFileError("a storage without a key")
        key, dtype, count = str(pid[2]), _dtype(pid[1]), int(pid[4])
        if key not in self.contents:
            self.contents[key] = self._make(key, count * dtype.itemsize)
            self.dtypes[key] = dtype
        data = self.contents[key]
        view = pid[5] if len(pid) > 5 else None
        _, start, count = view if isinstance(view, tuple) else (None, 0, count)
        if min(start, count) < 0 or (start + count) * dtype.itemsize > len(data):
            raise BrokenFileError(
                f"storage {key[:20]} is shorter than the {count} elements it should have"
            )
        if not count:
            return torch.empty(0, dtype=dtype)
        return torch.frombuffer(data, dtype=dtype, count=count, offset=start * dtype.itemsize)


def _dtype(kind: Any) -> torch.dtype:
    name = kind.path.rpartition(".")[2] if isinstance(kind, Name) else ""
    if name.startswith("Q"):
        raise BrokenFileError(
            f"its tensors are quantised, {name[:40]}; save their values as floats"
        )
    if name not in _DTYPES:
        raise BrokenFileError(f"a storage of type {name[:40] or '?'}")
    return _DTYPES[name]
