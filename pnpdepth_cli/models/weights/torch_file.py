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
from mmap import ACCESS_READ, mmap
from pathlib import Path
from typing import Any, TypeGuard

import torch
from torch import Tensor

from pnpdepth_cli.budget import check_claim
from pnpdepth_cli.models.weights.pickle_reader import (
    CONTENT_ERRORS,
    MAX_NAME,
    BrokenFileError,
    Name,
    StandIn,
    read_pickle,
)

_MAGIC = 0x1950A86A20F9469CFC6C
_MAX_DEPTH = 100
_MAX_MODULES = 100_000
_DTYPES: dict[str, torch.dtype] = {
    f"{name}Storage": getattr(torch, dtype)
    for name, dtype in {
        "Float": "float32", "Double": "float64", "Half": "float16", "BFloat16": "bfloat16",
        "Long": "int64", "Int": "int32", "Short": "int16", "Char": "int8", "Byte": "uint8",
        "Bool": "bool", "ComplexFloat": "complex64", "ComplexDouble": "complex128",
        "Untyped": "uint8",
    }.items()
}  # fmt: skip


def read_torch_file(path: Path) -> tuple[object, list[str]]:
    """Returns the content of a torch file, and the functions and classes that its pickle names.

    The content is tensors in plain containers, the state dict of each whole module, and a `StandIn`
    for all else; no name was run. A broken file raises whatever its parts do.
    """
    if zipfile.is_zipfile(path):
        content, names = _read_archive(path)
    else:
        with path.open("rb") as file, mmap(file.fileno(), 0, access=ACCESS_READ) as mapped:
            content, names = _read_row_of_pickles(mapped)
    if isinstance(content, Mapping):
        content = {key: _with_state(value) for key, value in content.items()}
    return _with_state(content), names


def _with_state(value: object) -> object:
    """The state dict of a whole pickled module, as the module itself would have given it."""
    return dict(_walk(value, "", itertools.count())) if _is_module(value) else value


def _is_module(value: object) -> TypeGuard[StandIn]:
    state = value.state if isinstance(value, StandIn) else None
    return isinstance(state, Mapping) and "_parameters" in state


def _walk(module: StandIn, prefix: str, visited: Iterator[int]) -> Iterator[tuple[str, Tensor]]:
    endless = next(visited) > _MAX_MODULES or prefix.count(".") > _MAX_DEPTH
    if endless or len(prefix) > MAX_NAME:
        raise BrokenFileError("its modules contain each other without end")
    fleeting = module.state.get("_non_persistent_buffers_set")
    # Not a set, in which other elements may take for ever to hash.
    left_out = [n for n in fleeting if isinstance(n, str)] if isinstance(fleeting, list) else []
    for kind in ("_parameters", "_buffers", "_modules"):
        entries = module.state.get(kind)
        for name, value in entries.items() if isinstance(entries, Mapping) else ():
            if kind == "_modules" and _is_module(value):
                yield from _walk(value, f"{prefix}{name}.", visited)
            elif kind != "_modules" and isinstance(value, Tensor) and name not in left_out:
                yield f"{prefix}{name}", value


def _read_archive(path: Path) -> tuple[object, list[str]]:
    with zipfile.ZipFile(path) as archive:
        entries = {info.filename: info for info in archive.infolist()}
        if any("/code/" in name for name in entries):
            raise BrokenFileError("it is TorchScript; save the state_dict() of its module instead")
        refuse_inflated(archive, path)
        pickles = [name for name in entries if name == "data.pkl" or name.endswith("/data.pkl")]
        if len(pickles) != 1:
            raise BrokenFileError(f"the archive has {len(pickles)} entries named data.pkl")
        folder = pickles[0].removesuffix("data.pkl")
        order = entries.get(f"{folder}byteorder")
        if order is not None and archive.read(order).strip() == b"big":
            raise BrokenFileError("it was written on a big-endian machine")
        storages = _Storages(lambda key, _: bytearray(archive.read(entries[f"{folder}data/{key}"])))
        return read_pickle(io.BytesIO(archive.read(pickles[0])), storages.load)


def refuse_inflated(archive: zipfile.ZipFile, path: Path) -> None:
    """Raises BrokenFileError for an archive whose entries are compressed, or overlap."""
    if any(info.compress_type != zipfile.ZIP_STORED for info in archive.infolist()):
        raise BrokenFileError("it is compressed, which torch never does")
    claimed, most = sum(info.file_size for info in archive.infolist()), path.stat().st_size
    check_claim(f"its entries have {claimed:,} bytes", claimed, most, error=BrokenFileError)


def _read_row_of_pickles(file: mmap) -> tuple[object, list[str]]:
    """The content of a torch file of before PyTorch 1.6, and the names in its pickle.

    Such a file has pickles of a magic number, the protocol, the system, the content, and the keys
    of the storages. Each storage's length and bytes follow, so that storages are filled at the end.
    """
    # It begins with the magic number.
    try:
        begins, _ = read_pickle(file)
    except CONTENT_ERRORS:  # of another kind of file
        begins = None
    if begins != _MAGIC:
        raise BrokenFileError("it begins as no torch file does")
    for _ in ("protocol", "system"):
        read_pickle(file)
    # The content, with storages of the size that it states.
    promised = 0

    def room_for(key: str, count: int) -> bytearray:
        nonlocal promised
        check_claim(
            f"a storage has {count:,} bytes", count, len(file) - promised, error=BrokenFileError
        )
        promised += count
        return bytearray(count)

    storages = _Storages(room_for)
    content, named = read_pickle(file, storages.load)
    # The bytes of each storage.
    keys, _ = read_pickle(file)
    keys = keys if isinstance(keys, list) else []
    names = [str(key) for key in keys if isinstance(key, str | int)]
    if {*names} != storages.contents.keys():
        raise BrokenFileError("its storages are not those that its pickle names")
    for key in names:
        memory = storages.contents[key]
        stored = int.from_bytes(file.read(8), "little") * storages.dtypes[key].itemsize
        part = file.read(len(memory))
        if not stored == len(memory) == len(part):
            raise BrokenFileError(f"storage {key[:20]} is shorter than it should be")
        memory[:] = part
    return content, named


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
        kind = pid[1].path.rpartition(".")[2] if isinstance(pid[1], Name) else ""
        if kind not in _DTYPES:
            raise BrokenFileError(f"a storage of type {kind[:40] or '?'}")
        key, dtype, count = str(pid[2]), _DTYPES[kind], int(pid[4])
        if key not in self.contents:
            self.contents[key] = self._make(key, count * dtype.itemsize)
            self.dtypes[key] = dtype
        data = self.contents[key]
        view = pid[5] if len(pid) > 5 else None
        _, start, count = view if isinstance(view, tuple) else (None, 0, count)
        if min(start, count) < 0 or (start + count) * dtype.itemsize > len(data):
            raise BrokenFileError(f"storage {key[:20]} is shorter than its {count} elements")
        if not count:
            return torch.empty(0, dtype=dtype)
        return torch.frombuffer(data, dtype=dtype, count=count, offset=start * dtype.itemsize)
