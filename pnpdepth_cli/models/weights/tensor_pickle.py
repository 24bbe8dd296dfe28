"""The tensors of a torch file whose pickle holds more than tensors; nothing in it is run.

Published checkpoints often hold whole modules, optimisers or command-line arguments; `Machine`
reads them without a call. Memory stays bounded by the size of the file: compressed archives,
storages larger than what is stored and tensors larger than their storage are refused, and tensors
of one storage share it. Both layouts of torch.save are read, the zip archive (torch ≥ 1.6) and the
older row of pickles.
"""

from __future__ import annotations

import io
import itertools
import struct
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, TypeGuard

import torch
from torch import Tensor

from pnpdepth_cli.errors import CheckpointError
from pnpdepth_cli.models.weights.pickle_machine import (
    NONSENSE,
    Broken,
    Instance,
    Machine,
    Name,
    brief,
)

_MAGIC = 0x1950A86A20F9469CFC6C
_DEEPEST = 100
_MOST_MODULES = 100_000

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
    "UntypedStorage": torch.uint8,
}


@dataclass(frozen=True, kw_only=True)
class TensorFile:
    """What a torch file holds, and the names of all that was not run."""

    content: Any
    named: tuple[str, ...]


def read_tensor_file(path: Path) -> TensorFile:
    """The content of a torch file. CheckpointError if it is broken or not one."""
    refuse_compressed(path)
    try:
        if zipfile.is_zipfile(path):
            return _read_archive(path)
        with path.open("rb") as file:
            return _read_row_of_pickles(file, path.stat().st_size)
    except Broken as error:
        reason: object = error
    except (zipfile.BadZipFile, OSError, EOFError, struct.error) as error:
        reason = error
    except NONSENSE as error:
        reason = f"{type(error).__name__}: {error}"
    raise CheckpointError(f"checkpoint {path} cannot be read as a torch file ({brief(reason)})")


def refuse_compressed(path: Path) -> None:
    """CheckpointError for a zip archive with a compressed entry, before anything unpacks it."""
    if not zipfile.is_zipfile(path):
        return
    try:
        with zipfile.ZipFile(path) as archive:
            entries = archive.infolist()
    except (zipfile.BadZipFile, OSError, ValueError, NotImplementedError):
        return  # torch says what is wrong with it
    # the source code in a TorchScript archive is compressed; torch says what that is
    packed = [info.filename for info in entries if info.compress_type != zipfile.ZIP_STORED]
    if any("/code/" not in name for name in packed):
        raise CheckpointError(f"checkpoint {path} is compressed, which torch never does")


def module_state(module: Instance) -> dict[str, Tensor]:
    """The state dict of a whole pickled module, as the module itself would have given it."""
    return dict(_walk(module, "", itertools.count()))


def is_module(value: Any) -> TypeGuard[Instance]:
    """True for a stand-in of a torch module."""
    return isinstance(value, Instance) and "_parameters" in value.state


def _walk(module: Instance, prefix: str, visited: Iterator[int]) -> Iterator[tuple[str, Tensor]]:
    if next(visited) > _MOST_MODULES or prefix.count(".") > _DEEPEST:
        raise CheckpointError("the checkpoint's modules contain each other without end")
    fleeting = _members(module.state.get("_non_persistent_buffers_set"))
    for kind in ("_parameters", "_buffers"):
        entries = module.state.get(kind)
        for name, value in entries.items() if isinstance(entries, dict) else ():
            if isinstance(value, Tensor) and name not in fleeting:
                yield f"{prefix}{name}", value
    inner = module.state.get("_modules")
    for name, value in inner.items() if isinstance(inner, dict) else ():
        if is_module(value):
            yield from _walk(value, f"{prefix}{name}.", visited)


def _members(value: Any) -> set[Any]:
    """The elements of a pickled set."""
    inside = value.arguments[0] if isinstance(value, Instance) and value.arguments else value
    return set(inside) if isinstance(inside, list | tuple) else set()


def _read_archive(path: Path) -> TensorFile:
    with zipfile.ZipFile(path) as archive:
        entries = {info.filename: info for info in archive.infolist()}
        pickles = [name for name in entries if name == "data.pkl" or name.endswith("/data.pkl")]
        if len(pickles) != 1:
            raise Broken(f"the archive has {len(pickles)} entries named data.pkl")
        whole = path.stat().st_size
        if sum(info.file_size for info in entries.values()) > whole:
            raise Broken("its entries are larger than the file")
        folder = pickles[0].removesuffix("data.pkl")
        order = entries.get(f"{folder}byteorder")
        if order is not None and archive.read(order).strip() == b"big":
            raise Broken("it was written on a big-endian machine")
        storages = _Storages(lambda key: archive.read(entries[f"{folder}data/{key}"]))
        with archive.open(pickles[0]) as file:
            machine = Machine(storages.load)
            content = machine.run(file, entries[pickles[0]].file_size)
        return TensorFile(content=content, named=tuple(machine.named))


def _read_row_of_pickles(file: IO[bytes], size: int) -> TensorFile:
    """magic, protocol, system, content, keys of the storages; then each storage's length and bytes.

    The content comes before the storages, so it is read twice: first for where they end.
    """
    header = Machine(lambda _: None)
    if header.run(file, size) != _MAGIC:
        raise Broken("it begins as no torch file does")
    header.run(file, size)
    header.run(file, size)
    start = file.tell()
    types: dict[str, torch.dtype] = {}

    def note(given: tuple[Any, ...]) -> None:
        types[str(given[2])] = _dtype(given[1])

    Machine(note, without_tensors=True).run(file, size)
    end = file.tell()
    keys = header.run(file, size)
    places: dict[str, tuple[int, int]] = {}
    for key in keys:
        (count,) = struct.unpack("<q", file.read(8))
        length = count * types[str(key)].itemsize
        if count < 0 or file.tell() + length > size:
            raise Broken(f"storage {key} goes beyond the end of the file")
        places[str(key)] = (file.tell(), length)
        file.seek(length, 1)

    def load(key: str) -> bytes:
        place, length = places[key]
        file.seek(place)
        return file.read(length)

    storages = _Storages(load)
    machine = Machine(storages.load)
    file.seek(start)
    pickled = io.BytesIO(file.read(end - start))  # loading storages moves the file's own position
    content = machine.run(pickled, size)
    return TensorFile(content=content, named=tuple(machine.named))


class _Storages:
    """The storages of a file, each read once."""

    def __init__(self, read: Callable[[str], bytes]) -> None:
        self._read, self._loaded = read, dict[str, Tensor]()

    def load(self, given: tuple[Any, ...]) -> Tensor:
        """The storage for ("storage", type, key, location, elements, …) as a flat tensor."""
        kind, key, count = given[1], str(given[2]), int(given[4])
        dtype = _dtype(kind)
        if key not in self._loaded:
            self._loaded[key] = torch.frombuffer(
                bytearray(self._read(key)) or bytearray(1), dtype=torch.uint8
            )
        data = self._loaded[key]
        view = given[5] if len(given) > 5 else None
        start = int(view[1]) if view else 0
        count = int(view[2]) if view else count
        first, length = start * dtype.itemsize, count * dtype.itemsize
        if first < 0 or length < 0 or first + length > len(data):
            raise Broken(f"storage {key} is shorter than the {count} elements it should have")
        part = data[first : first + length]
        return part.view(dtype) if length else torch.empty(0, dtype=dtype)


def _dtype(kind: Any) -> torch.dtype:
    name = kind.path.rpartition(".")[2] if isinstance(kind, Name) else str(kind)
    if name not in _DTYPES:
        raise Broken(f"a storage of type {name}")
    return _DTYPES[name]
