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
"""First number in a torch file of before PyTorch 1.6."""
_MAX_DEPTH = 100
"""Modules inside each other."""
_MAX_MODULES = 100_000
"""Modules of a network."""
_MAX_DICTS = 3
"""Dicts inside each other in a .npy file."""
_MAX_ENTRIES = 10_000
"""Arrays in a .npy file."""
_MAX_KEY = 20
"""Characters of a storage's key that a message shows."""
_MAX_KIND = 40
"""Characters of the name of a storage's type that a message shows."""
_COUNT_BYTES = 8
"""Bytes of the number of elements that stands before a storage's bytes in a row of pickles."""
_DTYPES: dict[str, torch.dtype] = {
    f"{name}Storage": getattr(torch, dtype)
    for name, dtype in {
        "Float": "float32", "Double": "float64", "Half": "float16", "BFloat16": "bfloat16",
        "Long": "int64", "Int": "int32", "Short": "int16", "Char": "int8", "Byte": "uint8",
        "Bool": "bool", "ComplexFloat": "complex64", "ComplexDouble": "complex128",
        "Untyped": "uint8",
    }.items()
}  # fmt: skip
"""Types of elements by the name of torch's storage."""


def read_torch_file(path: Path) -> tuple[object, list[str]]:
    """Returns the content of a torch file, and the names of functions and classes in its pickle.

    The content is tensors in plain containers, the state dict of each whole module, and a `StandIn`
    for all else; nothing that a name stands for was run.

    Raises:
        Exception: The file is broken; one of `CONTENT_ERRORS`.
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
    """Returns the state dict of a whole pickled module, or else the value itself."""
    match value:
        case StandIn(state=dict(module)) if "_parameters" in module:
            return dict(_tensors_of_module(module, "", itertools.count()))
    return value


def _tensors_of_module(
    module: Mapping[str, object], prefix: str, visited: Iterator[int]
) -> Iterator[tuple[str, Tensor]]:
    """Yields names and tensors of a module and its submodules, as its state_dict would have them.

    Args:
        module: Attributes of the pickled module.
        prefix: What its names begin with, such as "encoder.".
        visited: Counter of the modules of the network.

    Raises:
        InputError: There are too many modules, as where one contains itself.
    """
    is_endless = next(visited) > _MAX_MODULES or prefix.count(".") > _MAX_DEPTH
    if is_endless or len(prefix) > MAX_NAME:
        raise InputError("its modules contain each other without end")
    # Buffers that a state dict leaves out; a set was read as a list.
    left_out = module.get("_non_persistent_buffers_set")
    if not isinstance(left_out, list):
        left_out = []
    for kind in ("_parameters", "_buffers", "_modules"):
        entries = module.get(kind)
        if not isinstance(entries, Mapping):
            continue
        for name, value in entries.items():
            match value:
                case StandIn(state=dict(inside)) if kind == "_modules" and "_parameters" in inside:
                    yield from _tensors_of_module(inside, f"{prefix}{name}.", visited)
                case Tensor() if kind != "_modules" and name not in left_out:
                    yield f"{prefix}{name}", value


def _read_archive(path: Path) -> tuple[object, list[str]]:
    """Returns the content of a torch file of PyTorch 1.6 on, and the names in its pickle.

    Such a file is a zip archive, with the pickle in FOLDER/data.pkl and the bytes of each storage
    in FOLDER/data/KEY.

    Raises:
        Exception: The file is broken, or TorchScript; one of `CONTENT_ERRORS`.
    """
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

        def read_storage(key: str, _: int) -> bytearray:
            """Returns all bytes of a storage; the archive itself knows how many."""
            return bytearray(archive.read(entries[f"{folder}data/{key}"]))

        load = functools.partial(_load_storage, {}, read_storage)
        return read_pickle(io.BytesIO(archive.read(pickles[0])), load)


def refuse_inflated(archive: zipfile.ZipFile, path: Path) -> None:
    """Raises InputError for an archive whose entries are compressed, or overlap.

    Its content would not be bounded by the size of the file at `path`.
    """
    if any(info.compress_type != zipfile.ZIP_STORED for info in archive.infolist()):
        raise InputError("it is compressed, which torch never does")
    claimed = sum(info.file_size for info in archive.infolist())
    most = path.stat().st_size
    check_claim(f"its entries have {claimed:,} bytes", claimed, most)


def _read_row_of_pickles(file: mmap) -> tuple[object, list[str]]:
    """Returns the content of a torch file of before PyTorch 1.6, and the names in its pickle.

    Such a file has pickles of a magic number, the protocol, the system, the content, and the keys
    of the storages. Each storage's length and bytes follow, so that storages are filled at the end.

    Raises:
        Exception: The file is broken, or no torch file; one of `CONTENT_ERRORS`.
    """
    # It begins with the magic number.
    try:
        first_value, _ = read_pickle(file)
    except CONTENT_ERRORS:  # another kind of file
        first_value = None
    if first_value != _MAGIC:
        raise InputError("it begins as no torch file does")
    for _ in ("protocol", "system"):
        read_pickle(file)
    # The content, with empty storages of the size that it states.
    allocated = 0

    def allocate(key: str, byte_count: int) -> bytearray:
        """Returns the empty bytes of a storage; raises if the file cannot hold as many."""
        nonlocal allocated
        check_claim(f"a storage has {byte_count:,} bytes", byte_count, len(file) - allocated)
        allocated += byte_count
        return bytearray(byte_count)

    storages = dict[str, Tensor]()
    content, names = read_pickle(file, functools.partial(_load_storage, storages, allocate))
    # The bytes of each storage, in the order of the keys.
    listed, _ = read_pickle(file)
    listed = listed if isinstance(listed, list) else []
    keys = [str(key) for key in listed if isinstance(key, str | int)]
    if {*keys} != storages.keys():
        raise InputError("its storages are not those that its pickle names")
    for key in keys:
        memory = storages[key].view(torch.uint8).numpy()
        element_count = int.from_bytes(file.read(_COUNT_BYTES), "little")
        stored = file.read(len(memory))
        if not element_count * storages[key].itemsize == len(memory) == len(stored):
            raise InputError(f"storage {key[:_MAX_KEY]} is shorter than it should be")
        memory[:] = np.frombuffer(stored, np.uint8)
    return content, names


def _load_storage(
    storages: dict[str, Tensor],
    read: Callable[[str, int], bytearray],
    kind: str,
    key: str,
    count: int,
    more: Sequence[object],
) -> Tensor:
    """Returns a storage as a flat tensor, or the part of it that the pickle asks for.

    Args:
        storages: Storages that were read before, by key; this one is added.
        read: Function from a key and a number of bytes to these bytes.
        kind: Name of the storage's type, such as "FloatStorage".
        key: Key of the storage in the file.
        count: Number of its elements.
        more: What the pickle has behind these: nothing, None, or the part as (key of the view,
            index of the first element, number of elements).

    Raises:
        InputError: The type is not known, or the storage is shorter.
    """
    if kind not in _DTYPES:
        raise InputError(f"a storage of type {kind[:_MAX_KIND]}")
    dtype = _DTYPES[kind]
    if key not in storages:
        content = read(key, count * dtype.itemsize)
        # torch.frombuffer takes no empty buffer.
        storages[key] = (
            torch.frombuffer(content, dtype=dtype) if content else torch.empty(0, dtype=dtype)
        )
    # The whole storage or a part.
    start = 0
    if more and isinstance(more[0], tuple):
        _, start, count = more[0]
    if min(start, count) < 0 or start + count > len(storages[key]):
        raise InputError(f"storage {key[:_MAX_KEY]} is shorter than its {count} elements")
    if storages[key].dtype != dtype:
        raise InputError(f"storage {key[:_MAX_KEY]} has two types")
    return storages[key][start : start + count]


def read_numpy_file(path: Path) -> dict[str, Tensor]:
    """Returns the arrays of a .npy with a dict by name, those in a dict of it as "layer.name".

    The arrays keep their type and their order of axes.

    Raises:
        Exception: The file is broken, or holds no dict; one of `CONTENT_ERRORS`.
    """
    with path.open("rb") as file, mmap(file.fileno(), 0, access=ACCESS_READ) as content:
        if npy.read_magic(content) != (1, 0):
            raise InputError("it holds no dict of arrays")
        shape, _, dtype = npy.read_array_header_1_0(content)
        if not dtype.hasobject or shape != ():
            raise InputError(f"it holds one array of shape {shape}, not named arrays")
        array, _ = read_pickle(content)
        bytes_left = len(content)
    # The state of a pickled array ends with its elements; here the only one is the dict.
    match array:
        case StandIn(state=(_, _, _, _, [dict(arrays)])):
            entries = _flattened(arrays)
        case _:
            raise InputError("it holds no dict of arrays")
    # All arrays together have no more bytes than the file.
    tensors: dict[str, Tensor] = {}
    for name, value in entries:
        tensors[name] = _tensor_of_array(value, name, bytes_left)
        bytes_left -= tensors[name].nbytes
        count = len(tensors)
        check_claim(f"it has {count:,} arrays", count, _MAX_ENTRIES)
    return tensors


def _flattened(
    content: Mapping[Any, object], prefix: str = "", depth: int = 1
) -> Iterator[tuple[str, object]]:
    """Yields names and values of a dict and of the dicts in it; "." joins the keys.

    Args:
        content: The dict.
        prefix: Beginning of its names, such as "layer.".
        depth: Number of dicts that it lies in, itself included.

    Raises:
        InputError: Dicts are nested too deep.
    """
    if depth > _MAX_DICTS:
        raise InputError("its dicts are nested deeper than the layers of any network")
    for key, value in content.items():
        if isinstance(value, Mapping):
            yield from _flattened(value, f"{prefix}{key}.", depth + 1)
        else:
            yield f"{prefix}{key}", value


def _tensor_of_array(value: object, name: str, most: int) -> Tensor:
    """Returns a pickled NumPy array as a tensor.

    Args:
        value: Stand-in of the array.
        name: Name of the array, for messages.
        most: Bytes that the array may have.

    Raises:
        Exception: The value is no array of numbers, or too large; one of `CONTENT_ERRORS`.
    """
    # An array's state is version, shape, type, whether its first axis is the fastest, and bytes.
    match value:
        case StandIn(
            state=(_, tuple(shape), StandIn(_, (str(code), *_), (_, str(order), *_)), fortran, data)
        ) if isinstance(data, bytes | str):
            # Byte order, kind and bytes of a number, as in "<f4".
            dtype = np.dtype(f"{order[:1]}{code[:8]}")
            data = data.encode("latin-1") if isinstance(data, str) else data  # of Python 2
        case _:
            kind = value.path if isinstance(value, StandIn) else type(value).__name__
            raise InputError(f"{name} is a {kind}, not an array of numbers")
    check_claim(f"{name} has {len(data):,} bytes", len(data), most)
    shape = tuple(map(int, shape))
    if any(side < 0 for side in shape):
        raise InputError(f"{name} has a shape of {shape}")
    if dtype.kind not in "fiub":  # floats, integers with and without a sign, truth values
        raise InputError(f"{name} is an array of {dtype.str}, not of numbers")
    array = np.frombuffer(data, dtype) if data else np.empty(0, dtype)
    array = array.reshape(shape, order="F" if fortran else "C")
    # torch takes the byte order of the machine only.
    return torch.from_numpy(array.astype(dtype.newbyteorder("="), order="C"))
