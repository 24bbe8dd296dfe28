"""Tensors and plain containers of a torch file; nothing in the file is run.

Published checkpoints often hold whole modules, optimisers or command-line arguments;
`pickle_reader` reads them without a call. Both layouts of torch.save are read, the zip archive
(torch ≥ 1.6) and the older row of pickles. Memory stays bounded by the size of the file: compressed
archives, and storages and tensors larger than what is stored, are refused, and tensors of one
storage share it.

torch.load(weights_only=True) is not used: it allocates what a pickle asks for (bytearray(10**10)),
hashes what it holds, and refuses whole modules.
"""

from __future__ import annotations

import io
import itertools
import struct
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
_CHUNK = 1 << 20  # bytes read at once
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
_UNUSUAL_TENSORS = {
    "torch._utils._rebuild_sparse_tensor": "sparse",
    "torch._utils._rebuild_sparse_csr_tensor": "sparse",
    "torch._utils._rebuild_qtensor": "quantised",
    "torch._utils._rebuild_meta_tensor_no_storage": "on the meta device, without values",
    "torch._utils._rebuild_nested_tensor": "nested",
    "torch._utils._rebuild_device_tensor_from_numpy": "on a device without storages",
    "torch._utils._rebuild_device_tensor_from_cpu_tensor": "on a device without storages",
    "torch._utils._rebuild_wrapper_subclass": "of a class of its own",
}


@dataclass(frozen=True, kw_only=True)
class TensorFile:
    """What a torch file holds."""

    content: Any
    """Tensors in plain containers; a `StandIn` for everything else."""
    named: tuple[str, ...]
    """The functions and classes that its pickle names, none of which was run."""
    has_stand_ins: bool
    """True if it holds more than tensors and plain containers."""


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


def module_state(module: StandIn) -> dict[str, Tensor]:
    """Returns the state dict of a whole pickled module, as the module itself would have given it.

    Raises:
        CheckpointError: Its modules contain each other.
    """
    return dict(_walk(module, "", itertools.count()))


def is_module(value: Any) -> TypeGuard[StandIn]:
    """Returns True for a stand-in of a torch module."""
    return isinstance(value, StandIn) and "_parameters" in value.state


def unusual_tensor(value: Any) -> str | None:
    """Returns what keeps a pickled tensor from being read, such as "sparse"; None for others."""
    return _UNUSUAL_TENSORS.get(value.path) if isinstance(value, StandIn) else None


def _walk(module: StandIn, prefix: str, visited: Iterator[int]) -> Iterator[tuple[str, Tensor]]:
    endless = next(visited) > _MAX_MODULES or prefix.count(".") > _MAX_DEPTH
    if endless or len(prefix) > MAX_NAME:
        raise CheckpointError("the checkpoint's modules contain each other without end")
    not_persistent = _names_in_set(module.state.get("_non_persistent_buffers_set"))
    for kind in ("_parameters", "_buffers"):
        for name, value in _entries(module.state.get(kind)):
            if isinstance(value, Tensor) and name not in not_persistent:
                yield f"{prefix}{name}", value
    for name, value in _entries(module.state.get("_modules")):
        if is_module(value):
            yield from _walk(value, f"{prefix}{name}.", visited)


def _entries(value: Any) -> list[tuple[Any, Any]]:
    return list(value.items()) if isinstance(value, Mapping) else []


def _names_in_set(value: Any) -> set[str]:
    """The texts in a pickled set; other elements may take for ever to hash."""
    elements = value.arguments[0] if isinstance(value, StandIn) and value.arguments else value
    if not isinstance(elements, list | tuple):
        return set()
    return {element for element in elements if isinstance(element, str)}


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

        def load(key: str) -> Tensor:
            info = entries[f"{folder}data/{key}"]
            with archive.open(info) as storage:
                return _bytes_of(storage, info.file_size)

        storages = _Storages(load)
        with archive.open(pickles[0]) as pickled:
            return _read_pickle(pickled, storages)


def _read_row_of_pickles(file: IO[bytes], size: int) -> TensorFile:
    """magic, protocol, system, content, keys of the storages; then each storage's length and bytes.

    The content comes before the storages, so it is read twice: first for where they end.
    """

    def read_object(load_storage: Any = lambda _: None, *, skip_tensors: bool = False) -> Any:
        return PickleReader(file, load_storage, skip_tensors=skip_tensors).read_object()

    if read_object() != _MAGIC:
        raise BrokenFileError("it begins as no torch file does")
    read_object()
    read_object()
    start = file.tell()
    types: dict[str, torch.dtype] = {}

    def note_type(pid: tuple[Any, ...]) -> None:
        types[_storage_key(pid)] = _dtype(pid[1])

    read_object(note_type, skip_tensors=True)
    end = file.tell()
    keys = read_object()
    extents: dict[str, tuple[int, int]] = {}
    for key in keys if isinstance(keys, list) else ():
        (count,) = struct.unpack("<q", file.read(8))
        length = count * types[str(key)[:MAX_NAME]].itemsize
        if count < 0 or file.tell() + length > size:
            raise BrokenFileError("a storage goes beyond the end of the file")
        extents[str(key)] = (file.tell(), length)
        file.seek(length, 1)

    def load(key: str) -> Tensor:
        position, length = extents[key]
        file.seek(position)
        return _bytes_of(file, length)

    file.seek(start)
    pickled = io.BytesIO(file.read(end - start))  # loading storages moves the file's own position
    return _read_pickle(pickled, _Storages(load))


def _read_pickle(file: IO[bytes], storages: _Storages) -> TensorFile:
    reader = PickleReader(file, storages.load)
    content = reader.read_object()
    return TensorFile(
        content=content, named=tuple(reader.named), has_stand_ins=reader.has_stand_ins
    )


class _Storages:
    """The storages of a file, each read once."""

    def __init__(self, read: Callable[[str], Tensor]) -> None:
        self._read, self._loaded = read, dict[str, Tensor]()

    def load(self, pid: tuple[Any, ...]) -> Tensor:
        """The storage for ("storage", type, key, location, elements, ...) as a flat tensor."""
        key, dtype, count = _storage_key(pid), _dtype(pid[1]), int(pid[4])
        if key not in self._loaded:
            self._loaded[key] = self._read(key)
        data = self._loaded[key]
        view = pid[5] if len(pid) > 5 else None
        start = int(view[1]) if view else 0
        count = int(view[2]) if view else count
        first, length = start * dtype.itemsize, count * dtype.itemsize
        if first < 0 or length < 0 or first + length > len(data):
            raise BrokenFileError(
                f"storage {key[:20]} is shorter than the {count} elements it should have"
            )
        part = data[first : first + length]
        return part.view(dtype) if length else torch.empty(0, dtype=dtype)


def _bytes_of(file: IO[bytes], size: int) -> Tensor:
    """The next bytes of a file, in memory that tensors can share."""
    content = torch.empty(size, dtype=torch.uint8)
    array: Any = content.numpy()
    view = memoryview(array)
    filled = 0
    while filled < size:
        count = file.readinto(view[filled : filled + _CHUNK])  # type: ignore[attr-defined]
        if not count:
            raise BrokenFileError("a storage goes beyond the end of the file")
        filled += count
    return content


def _storage_key(pid: tuple[Any, ...]) -> str:
    if not isinstance(pid[2], str | int):
        raise BrokenFileError("a storage without a key")
    return str(pid[2])


def _dtype(kind: Any) -> torch.dtype:
    name = kind.path.rpartition(".")[2] if isinstance(kind, Name) else ""
    if name.startswith("Q"):
        raise BrokenFileError(
            f"its tensors are quantised, {name[:40]}; save their values as floats"
        )
    if name not in _DTYPES:
        raise BrokenFileError(f"a storage of type {name[:40] or '?'}")
    return _DTYPES[name]
