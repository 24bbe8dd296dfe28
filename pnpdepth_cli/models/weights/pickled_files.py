"""Tensors and plain containers of torch and numpy files, which are pickles; nothing in them is run.

Both layouts of torch.save are read, the zip archive (torch ≥ 1.6) and the older row of pickles, and
the .npy of a dict of arrays, or of dicts of arrays, as converters from Caffe write it. Memory stays
bounded by the size of the file: compressed archives, and storages and tensors larger than what is
stored, are refused, and tensors of one storage share it.
"""

from __future__ import annotations

import functools
import io
import itertools
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from mmap import ACCESS_READ, mmap
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.lib import format as npy
from torch import Tensor

from pnpdepth_cli.budget import check_claim
from pnpdepth_cli.errors import InputError
from pnpdepth_cli.models.weights.pickle_reader import CONTENT_ERRORS, MAX_NAME, StandIn, read_pickle

_MAGIC = 0x1950A86A20F9469CFC6C
_MAX_DEPTH = 100  # of modules inside each other
_MAX_MODULES = 100_000
_MAX_DICTS = 3  # inside each other
_MAX_ENTRIES = 10_000
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
    match value:
        case StandIn(state=dict(module)) if "_parameters" in module:
            return dict(_walk(module, "", itertools.count()))
    return value


def _walk(
    module: Mapping[str, object], prefix: str, visited: Iterator[int]
) -> Iterator[tuple[str, Tensor]]:
    endless = next(visited) > _MAX_MODULES or prefix.count(".") > _MAX_DEPTH
    if endless or len(prefix) > MAX_NAME:
        raise InputError("its modules contain each other without end")
    fleeting = module.get("_non_persistent_buffers_set")  # a list, as sets are read
    for kind in ("_parameters", "_buffers", "_modules"):
        entries = module.get(kind)
        for name, value in entries.items() if isinstance(entries, Mapping) else ():
            match value:
                case StandIn(state=dict(inside)) if kind == "_modules" and "_parameters" in inside:
                    yield from _walk(inside, f"{prefix}{name}.", visited)
                case Tensor() if kind != "_modules":
                    if not isinstance(fleeting, list) or name not in fleeting:
                        yield f"{prefix}{name}", value


def _read_archive(path: Path) -> tuple[object, list[str]]:
    with zipfile.ZipFile(path) as archive:
        entries = {info.filename: info for info in archive.infolist()}
        if any("/code/" in name for name in entries):
            raise InputError("it is TorchScript; save the state_dict() of its module instead")
        refuse_inflated(archive, path)
        pickles = [name for name in entries if name == "data.pkl" or name.endswith("/data.pkl")]
        if len(pickles) != 1:
            raise InputError(f"the archive has {len(pickles)} entries named data.pkl")
        folder = pickles[0].removesuffix("data.pkl")
        order = entries.get(f"{folder}byteorder")
        if order is not None and archive.read(order).strip() == b"big":
            raise InputError("it was written on a big-endian machine")

        def read(key: str, _: int) -> bytearray:
            return bytearray(archive.read(entries[f"{folder}data/{key}"]))

        load = functools.partial(_load_storage, {}, read)
        return read_pickle(io.BytesIO(archive.read(pickles[0])), load)


def refuse_inflated(archive: zipfile.ZipFile, path: Path) -> None:
    """Raises InputError for an archive whose entries are compressed, or overlap."""
    if any(info.compress_type != zipfile.ZIP_STORED for info in archive.infolist()):
        raise InputError("it is compressed, which torch never does")
    claimed = sum(info.file_size for info in archive.infolist())
    most = path.stat().st_size
    check_claim(f"its entries have {claimed:,} bytes", claimed, most)


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
        raise InputError("it begins as no torch file does")
    for _ in ("protocol", "system"):
        read_pickle(file)
    # The content, with storages of the size that it states.
    promised = 0

    def room_for(key: str, count: int) -> bytearray:
        nonlocal promised
        check_claim(f"a storage has {count:,} bytes", count, len(file) - promised)
        promised += count
        return bytearray(count)

    storages = dict[str, Tensor]()
    content, named = read_pickle(file, functools.partial(_load_storage, storages, room_for))
    # The bytes of each storage.
    keys, _ = read_pickle(file)
    keys = keys if isinstance(keys, list) else []
    names = [str(key) for key in keys if isinstance(key, str | int)]
    if {*names} != storages.keys():
        raise InputError("its storages are not those that its pickle names")
    for key in names:
        memory = storages[key].view(torch.uint8).numpy()
        stored = int.from_bytes(file.read(8), "little") * storages[key].itemsize
        part = file.read(len(memory))
        if not stored == len(memory) == len(part):
            raise InputError(f"storage {key[:20]} is shorter than it should be")
        memory[:] = np.frombuffer(part, np.uint8)
    return content, named


def _load_storage(
    storages: dict[str, Tensor], read: Callable[[str, int], bytearray],
    kind: str, key: str, count: int, more: Sequence[object],
) -> Tensor:  # fmt: skip
    """The storage, made once of what `read` returns for its key and bytes; or a view of it."""
    if kind not in _DTYPES:
        raise InputError(f"a storage of type {kind[:40]}")
    dtype = _DTYPES[kind]
    if key not in storages:
        data = read(key, count * dtype.itemsize)
        storages[key] = torch.frombuffer(data, dtype=dtype) if data else torch.empty(0, dtype=dtype)
    _, start, count = more[0] if more and isinstance(more[0], tuple) else (None, 0, count)
    if min(start, count) < 0 or start + count > len(storages[key]):
        raise InputError(f"storage {key[:20]} is shorter than its {count} elements")
    if storages[key].dtype != dtype:
        raise InputError(f"storage {key[:20]} has two types")
    return storages[key][start : start + count]


def read_numpy_file(path: Path) -> dict[str, Tensor]:
    """Returns the arrays of a .npy with a dict by name, those in a dict of it as "layer.name".

    The arrays keep their type and their order of axes. A broken file raises whatever its parts do.
    """
    with path.open("rb") as file, mmap(file.fileno(), 0, access=ACCESS_READ) as content:
        if npy.read_magic(content) != (1, 0):
            raise InputError("it holds no dict of arrays")
        shape, _, dtype = npy.read_array_header_1_0(content)
        if not dtype.hasobject or shape != ():
            raise InputError(f"it holds one array of shape {shape}, not named arrays")
        array, _ = read_pickle(content)
        left = len(content)
    match array:
        case StandIn(state=(_, _, _, _, [dict(arrays)])):
            entries = _entries(arrays)
        case _:
            raise InputError("it holds no dict of arrays")
    tensors: dict[str, Tensor] = {}
    for name, value in entries:
        tensors[name] = _unpickle(value, name, left)
        left -= tensors[name].nbytes
        count = len(tensors)
        check_claim(f"it has {count:,} arrays", count, _MAX_ENTRIES)
    return tensors


def _entries(
    content: Mapping[Any, object], prefix: str = "", depth: int = 1
) -> Iterator[tuple[str, object]]:
    """All that lies in the dict and in the dicts in it, by name; "." joins the keys."""
    if depth > _MAX_DICTS:
        raise InputError("its dicts are nested deeper than the layers of any network")
    for key, value in content.items():
        if isinstance(value, Mapping):
            yield from _entries(value, f"{prefix}{key}.", depth + 1)
        else:
            yield f"{prefix}{key}", value


def _unpickle(value: object, name: str, most: int) -> Tensor:
    """The tensor of a pickled array of at most so many bytes."""
    match value:
        case StandIn(
            state=(_, tuple(shape), StandIn(_, (str(code), *_), (_, str(order), *_)), fortran, data)
        ) if isinstance(data, bytes | str):
            number = np.dtype(f"{order[:1]}{code[:8]}")
            data = data.encode("latin-1") if isinstance(data, str) else data  # of Python 2
        case _:
            kind = value.path if isinstance(value, StandIn) else type(value).__name__
            raise InputError(f"{name} is a {kind}, not an array of numbers")
    check_claim(f"{name} has {len(data):,} bytes", len(data), most)
    shape = tuple(map(int, shape))
    if any(side < 0 for side in shape):
        raise InputError(f"{name} has a shape of {shape}")
    if number.kind not in "fiub":
        raise InputError(f"{name} is an array of {number.str}, not of numbers")
    array = np.frombuffer(data, number) if data else np.empty(0, number)
    array = array.reshape(shape, order="F" if fortran else "C")
    return torch.from_numpy(array.astype(number.newbyteorder("="), order="C"))
