"""The tensors of a torch file whose pickle holds more than tensors; nothing in it is run.

Published checkpoints often hold whole modules, optimisers or command-line arguments. A pickle is a
program for a stack machine that may call anything; this machine calls nothing. It knows tensors
and plain containers, and stands an inert `Instance` for everything else. Memory stays bounded by
the size of the file: compressed archives, storages larger than what is stored and tensors larger
than their storage are refused. Both layouts of torch.save are read, the zip archive (torch ≥ 1.6)
and the older row of pickles.
"""

from __future__ import annotations

import io
import itertools
import pickletools
import struct
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any, TypeGuard

import torch
from torch import Tensor

from pnpdepth_cli.errors import CheckpointError

_MAGIC = 0x1950A86A20F9469CFC6C
_LONGEST_PICKLE = 1 << 28  # bytes; a pickle beside the storages is far smaller
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
_PARAMETERS = ("torch._utils._rebuild_parameter", "torch.nn.parameter.Parameter")
_MAPPINGS = (
    "collections.OrderedDict",
    "collections.defaultdict",
    "builtins.dict",
    "__builtin__.dict",
)


@dataclass(frozen=True)
class Name:
    """A function or class that the pickle names; never looked up."""

    path: str


@dataclass(eq=False)
class Instance:
    """What calling something would have given: its name, its arguments, and the state it got."""

    path: str
    arguments: tuple[Any, ...] = ()
    state: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class TensorFile:
    """What a torch file holds, and the names of all that was not run."""

    content: Any
    named: tuple[str, ...]


class _Broken(Exception):
    """The file is not what torch writes; the message says how."""


def read_tensor_file(path: Path) -> TensorFile:
    """The content of a torch file. CheckpointError if it is broken or not one."""
    try:
        if zipfile.is_zipfile(path):
            return _read_archive(path)
        with path.open("rb") as file:
            return _read_row_of_pickles(file, path.stat().st_size)
    except _Broken as error:
        reason: object = error
    except (zipfile.BadZipFile, OSError, EOFError, struct.error) as error:
        reason = error
    except (ValueError, TypeError, KeyError, IndexError, AttributeError, RuntimeError) as error:
        # What the machine's own steps raise when the program on its stack makes no sense.
        reason = f"{type(error).__name__}: {error}"
    raise CheckpointError(f"checkpoint {path} cannot be read as a torch file ({reason})")


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
            raise _Broken(f"the archive has {len(pickles)} entries named data.pkl")
        if any(info.compress_type != zipfile.ZIP_STORED for info in entries.values()):
            raise _Broken("the archive is compressed, which torch never does")
        whole = path.stat().st_size
        if sum(info.file_size for info in entries.values()) > whole:
            raise _Broken("its entries are larger than the file")
        folder = pickles[0].removesuffix("data.pkl")
        order = entries.get(f"{folder}byteorder")
        if order is not None and archive.read(order).strip() == b"big":
            raise _Broken("it was written on a big-endian machine")
        storages = _Storages(lambda key: archive.read(entries[f"{folder}data/{key}"]))
        with archive.open(pickles[0]) as file:
            machine = _Machine(storages.load)
            content = machine.run(file, entries[pickles[0]].file_size)
        return TensorFile(content=content, named=tuple(machine.named))


def _read_row_of_pickles(file: IO[bytes], size: int) -> TensorFile:
    """magic, protocol, system, content, keys of the storages; then each storage's length and bytes.

    The content comes before the storages, so it is read twice: first for where they end.
    """
    header = _Machine(lambda _: None)
    if header.run(file, size) != _MAGIC:
        raise _Broken("it begins as no torch file does")
    header.run(file, size)
    header.run(file, size)
    start = file.tell()
    types: dict[str, torch.dtype] = {}

    def note(given: tuple[Any, ...]) -> None:
        types[str(given[2])] = _dtype(given[1])

    _Machine(note, without_tensors=True).run(file, size)
    end = file.tell()
    keys = header.run(file, size)
    places: dict[str, tuple[int, int]] = {}
    for key in keys:
        (count,) = struct.unpack("<q", file.read(8))
        length = count * types[str(key)].itemsize
        if count < 0 or file.tell() + length > size:
            raise _Broken(f"storage {key} goes beyond the end of the file")
        places[str(key)] = (file.tell(), length)
        file.seek(length, 1)

    def load(key: str) -> bytes:
        place, length = places[key]
        file.seek(place)
        return file.read(length)

    storages = _Storages(load)
    machine = _Machine(storages.load)
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
            raise _Broken(f"storage {key} is shorter than the {count} elements it should have")
        part = data[first : first + length]
        return part.view(dtype) if length else torch.empty(0, dtype=dtype)


def _dtype(kind: Any) -> torch.dtype:
    name = kind.path.rpartition(".")[2] if isinstance(kind, Name) else str(kind)
    if name not in _DTYPES:
        raise _Broken(f"a storage of type {name}")
    return _DTYPES[name]


class _Machine:
    """Pickle's stack machine, without its calls."""

    def __init__(
        self, load_storage: Callable[[tuple[Any, ...]], Any], *, without_tensors: bool = False
    ) -> None:
        self._load_storage, self._without_tensors = load_storage, without_tensors
        self.named: dict[str, None] = {}

    def run(self, file: Any, size: int) -> Any:
        """The object of the pickle that begins here; the file stands behind it."""
        self._stack: list[Any] = []
        self._marks: list[int] = []
        self._memo: dict[int, Any] = {}
        limit = min(size, _LONGEST_PICKLE)
        start = file.tell()
        for opcode, argument, place in pickletools.genops(file):
            if place is not None and place - start > limit:
                raise _Broken("its pickle does not end")
            if opcode.name == "STOP":
                return self._stack.pop()
            self._step(opcode.name, argument)
        raise _Broken("its pickle does not end")

    def _step(self, name: str, argument: Any) -> None:
        if name in _CONSTANTS:
            self._stack.append(_CONSTANTS[name]())
        elif name in _LITERALS:
            self._stack.append(argument)
        elif name in _IGNORED:
            return
        else:
            step = getattr(self, f"_{name.lower()}", None)
            if step is None:
                raise _Broken(f"its pickle uses {name}")
            step(argument)

    def _since_mark(self) -> list[Any]:
        mark = self._marks.pop()
        values = self._stack[mark:]
        del self._stack[mark:]
        return values

    def _mark(self, _: Any) -> None:
        self._marks.append(len(self._stack))

    def _pop(self, _: Any) -> None:
        if self._marks and self._marks[-1] == len(self._stack):
            self._marks.pop()
        else:
            self._stack.pop()

    def _pop_mark(self, _: Any) -> None:
        self._since_mark()

    def _dup(self, _: Any) -> None:
        self._stack.append(self._stack[-1])

    def _put(self, index: Any) -> None:
        self._memo[int(index)] = self._stack[-1]

    _binput = _long_binput = _put

    def _memoize(self, _: Any) -> None:
        self._memo[len(self._memo)] = self._stack[-1]

    def _get(self, index: Any) -> None:
        self._stack.append(self._memo[int(index)])

    _binget = _long_binget = _get

    def _tuple(self, _: Any) -> None:
        self._stack.append(tuple(self._since_mark()))

    def _list(self, _: Any) -> None:
        self._stack.append(self._since_mark())

    def _frozenset(self, _: Any) -> None:
        self._stack.append(Instance("builtins.frozenset", (self._since_mark(),)))

    def _dict(self, _: Any) -> None:
        values = self._since_mark()
        self._stack.append(_pairs(values))

    def _tuple1(self, _: Any) -> None:
        self._stack[-1:] = [tuple(self._stack[-1:])]

    def _tuple2(self, _: Any) -> None:
        self._stack[-2:] = [tuple(self._stack[-2:])]

    def _tuple3(self, _: Any) -> None:
        self._stack[-3:] = [tuple(self._stack[-3:])]

    def _append(self, _: Any) -> None:
        value = self._stack.pop()
        self._extend([value])

    def _appends(self, _: Any) -> None:
        self._extend(self._since_mark())

    _additems = _appends

    def _extend(self, values: list[Any]) -> None:
        # An instance that extends itself, such as a list's subclass, stays empty.
        if isinstance(self._stack[-1], list):
            self._stack[-1].extend(values)

    def _setitem(self, _: Any) -> None:
        value, key = self._stack.pop(), self._stack.pop()
        self._update([key, value])

    def _setitems(self, _: Any) -> None:
        self._update(self._since_mark())

    def _update(self, values: list[Any]) -> None:
        if isinstance(self._stack[-1], dict):
            self._stack[-1].update(_pairs(values))

    def _global(self, argument: str) -> None:
        self._name(argument.replace(" ", ".", 1))

    def _stack_global(self, _: Any) -> None:
        name, module = self._stack.pop(), self._stack.pop()
        self._name(f"{module}.{name}")

    def _name(self, path: str) -> None:
        self.named.setdefault(path)
        self._stack.append(Name(path))

    def _persid(self, argument: Any) -> None:
        raise _Broken("its pickle refers to something outside it")

    def _binpersid(self, _: Any) -> None:
        given = self._stack.pop()
        if isinstance(given, tuple) and given and given[0] == "module":
            self._stack.append(given[1])  # a class with its source text; the text is dropped
        elif isinstance(given, tuple) and len(given) >= 5 and given[0] == "storage":
            self._stack.append(self._load_storage(given))
        else:
            raise _Broken("its pickle refers to something outside it")

    def _reduce(self, _: Any) -> None:
        arguments, function = self._stack.pop(), self._stack.pop()
        self._stack.append(self._called(function, tuple(arguments)))

    _newobj = _reduce

    def _newobj_ex(self, _: Any) -> None:
        self._stack.pop()
        self._reduce(None)

    def _inst(self, argument: str) -> None:
        path = argument.replace(" ", ".", 1)
        self.named.setdefault(path)
        self._stack.append(self._called(Name(path), tuple(self._since_mark())))

    def _obj(self, _: Any) -> None:
        function, *arguments = self._since_mark()
        self._stack.append(self._called(function, tuple(arguments)))

    def _build(self, _: Any) -> None:
        state = self._stack.pop()
        target = self._stack[-1]
        if isinstance(target, Instance):
            for part in state if isinstance(state, tuple) else (state,):
                if isinstance(part, dict):
                    target.state.update(part)

    def _called(self, function: Any, arguments: tuple[Any, ...]) -> Any:
        """What stands for the result; only tensors and plain containers are made."""
        if not isinstance(function, Name):
            return Instance("?", arguments)
        path = function.path
        if path in _MAPPINGS:
            first = arguments[0] if arguments and isinstance(arguments[0], list) else []
            return dict(first)
        if path == "torch.Size":
            return arguments[0] if arguments else ()
        if path == "copyreg._reconstructor" or path == "copy_reg._reconstructor":
            inner = arguments[0]
            return Instance(inner.path if isinstance(inner, Name) else "?")
        if path in ("torch._utils._rebuild_tensor_v2", "torch._utils._rebuild_tensor"):
            return None if self._without_tensors else _view(*arguments[:4])
        if path.startswith(_PARAMETERS):
            return arguments[0]
        return Instance(path, arguments)


def _pairs(values: list[Any]) -> dict[Any, Any]:
    """Keys and values in turn; a key that is no plain value stands under its type."""
    plain = str | int | float | bool | None
    keys = (k if isinstance(k, plain) else type(k).__name__ for k in values[::2])
    return dict(zip(keys, values[1::2], strict=True))


def _view(storage: Any, offset: Any, shape: Any, stride: Any) -> Tensor:
    if not isinstance(storage, Tensor):
        raise _Broken("a tensor without a storage")
    shape, stride = tuple(map(int, shape)), tuple(map(int, stride))
    offset = int(offset)
    empty = any(n == 0 for n in shape)
    reach = sum((n - 1) * s for n, s in zip(shape, stride, strict=True))
    count = 1
    for n in shape:
        count *= n
    bad = offset < 0 or any(n < 0 for n in shape) or any(s < 0 for s in stride)
    if bad or (not empty and (offset + reach >= len(storage) or count > len(storage))):
        raise _Broken(f"a tensor of shape {shape} goes beyond its storage of {len(storage)}")
    return storage.as_strided(shape, stride, offset).clone()


_CONSTANTS: dict[str, Callable[[], Any]] = {
    "NONE": lambda: None,
    "NEWTRUE": lambda: True,
    "NEWFALSE": lambda: False,
    "EMPTY_LIST": list,
    "EMPTY_DICT": dict,
    "EMPTY_TUPLE": tuple,
    "EMPTY_SET": lambda: Instance("builtins.set", ([],)),
}
_LITERALS = frozenset(
    {
        *("INT", "BININT", "BININT1", "BININT2", "LONG", "LONG1", "LONG4", "FLOAT", "BINFLOAT"),
        *("STRING", "BINSTRING", "SHORT_BINSTRING", "UNICODE", "BINUNICODE", "SHORT_BINUNICODE"),
        *("BINUNICODE8", "BINBYTES", "SHORT_BINBYTES", "BINBYTES8", "BYTEARRAY8"),
    }
)
_IGNORED = frozenset(["PROTO", "FRAME"])
