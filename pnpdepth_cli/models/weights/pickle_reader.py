"""Reads a pickle without calling anything that it names.

A pickle is a program that may call any function. `PickleReader` is the standard library's unpickler
in pure Python with an allow-list of its opcodes. Names are never imported: a call of one gives a
tensor, a plain container or an inert `StandIn`. Opcodes that call, set attributes or hash values of
the file are replaced; one that is not on the list is an error.

Time and memory are bounded: a pickle has at most `MAX_STEPS` opcodes, where an opcode that copies n
values counts as n, and no opcode reads more bytes than the file has. torch.load(weights_only=True)
is not used: it allocates what a pickle asks for, hashes what it holds, and refuses whole modules.
"""

from __future__ import annotations

import lzma
import math
import pickle
import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, cast

import torch
from torch import Tensor

MAX_STEPS = 3_000_000
"""Opcodes, and values copied by them. A checkpoint of 2,000 tensors has about 100,000."""

MAX_NAME = 1_000
"""Characters of a name in a pickle."""

MAX_AXES = 64

_MAX_BYTES = 1 << 28  # of a pickle beside its storages; real ones are far smaller
_MAX_EXPANDED = 1 << 28  # elements of a tensor with strides of 0; nothing is allocated for them
_MAPPINGS = (
    *("collections.OrderedDict", "collections.defaultdict"),
    *("builtins.dict", "__builtin__.dict"),
)
_TENSORS = ("torch._utils._rebuild_tensor", "torch._utils._rebuild_tensor_v2")
_PARAMETERS = ("torch._utils._rebuild_parameter", "torch.nn.parameter.Parameter")
_DTYPES = {str(value): value for value in vars(torch).values() if isinstance(value, torch.dtype)}

READ_ERRORS = (
    *(ValueError, TypeError, KeyError, IndexError, AttributeError, RuntimeError, AssertionError),
    *(OverflowError, MemoryError, EOFError, struct.error),
    *(pickle.UnpicklingError, zlib.error, lzma.LZMAError),
)
"""What reading a file that makes no sense raises; MemoryError at a length that no file has."""


class BrokenFileError(Exception):
    """A file is not what it should be; the message says how."""


@dataclass(frozen=True)
class Name:
    """A function or class that the pickle names; it is never looked up."""

    path: str
    call: Callable[[str, tuple[Any, ...]], Any]

    def __call__(self, *arguments: Any) -> Any:
        """Returns what stands for the result of the call."""
        return self.call(self.path, arguments)


@dataclass(eq=False, repr=False)
class StandIn:
    """Stands for what a call would have returned.

    path: dotted name of what would have been called, with these arguments. state: the attributes
    that the result would have been given; built: the same as pickled.
    """

    path: str
    arguments: tuple[Any, ...] = ()
    state: dict[str, Any] = field(default_factory=dict)
    built: Any = None

    def append(self, value: Any) -> None:
        """Does nothing, as for a subclass of list."""

    extend = append


def brief(reason: object) -> str:
    """Returns the reason on one line of at most 160 characters; parts may come out of the file."""
    text = f"{type(reason).__name__}: {reason}" if type(reason) in READ_ERRORS else str(reason)
    return " ".join(text[:1000].split())[:160]


class PickleReader(pickle._Unpickler):
    """Reads one pickle by `load()`, which raises BrokenFileError or another of READ_ERRORS.

    Args:
        file: Stands at the first opcode; afterwards behind the last.
        load_storage: Returns the flat tensor for a persistent id
            ("storage", type, key, location, elements, ...).
        max_bytes: The most bytes that the pickle may have.
    """

    stack: list[Any]  # left out by the stubs of the standard library, like the next two
    read: Callable[[int], bytes]
    pop_mark: Callable[[], list[Any]]

    def __init__(
        self,
        file: Any,
        load_storage: Callable[[tuple[Any, ...]], Tensor],
        max_bytes: int = _MAX_BYTES,
    ) -> None:
        super().__init__(_BoundedFile(file, max_bytes), encoding="latin-1")
        self._load_storage, self._steps = load_storage, MAX_STEPS
        self.named: dict[str, None] = {}
        self.has_stand_ins = False

    def charge(self, steps: int) -> None:
        """Counts the steps; raises BrokenFileError after too many."""
        self._steps -= steps
        if self._steps < 0:
            raise BrokenFileError(f"its pickle takes more than {MAX_STEPS:,} steps")

    def find_class(self, module: str, name: str) -> Name:
        """Returns the name itself; nothing is imported."""
        if len(module) + len(name) > MAX_NAME:
            raise BrokenFileError("its pickle has a name without end")
        self.named.setdefault(f"{module}.{name}")
        return Name(f"{module}.{name}", self._called)

    def persistent_load(self, pid: Any) -> Any:
        """Returns the storage, or the class without its source text, that the id stands for."""
        if isinstance(pid, tuple) and len(pid) > 1 and pid[0] == "module":
            return pid[1]
        if isinstance(pid, tuple) and len(pid) >= 5 and pid[0] == "storage":
            return self._load_storage(pid)
        raise BrokenFileError("its pickle refers to something outside it")

    def _called(self, path: str, arguments: tuple[Any, ...]) -> Any:
        """What stands for a call's result; only tensors and plain containers are made."""
        if path in _MAPPINGS:
            pairs = arguments[0] if arguments and isinstance(arguments[0], list) else []
            self.charge(len(pairs))
            return _mapping([value for pair in pairs for value in _two(pair)])
        if path == "torch.Size":
            return arguments[0] if arguments else ()
        if path in ("copyreg._reconstructor", "copy_reg._reconstructor"):
            path, arguments = getattr(arguments[0], "path", "?"), ()
        elif path in _TENSORS:
            return _view(*arguments[:4])
        elif path == "torch._utils._rebuild_tensor_v3":  # of a dtype that storages do not name
            storage, offset, shape, stride = arguments[:4]
            return _view(storage, offset, shape, stride, arguments[6])
        elif path == "torch._tensor._rebuild_from_type_v2":  # it has attributes of its own
            return self._call(arguments[0], arguments[2])
        elif path.startswith(_PARAMETERS):
            return arguments[0]
        self.has_stand_ins = True
        return StandIn(path, arguments)

    def _load_call(self) -> None:
        arguments, function = self.stack.pop(), self.stack.pop()
        self.stack.append(self._call(function, arguments))

    def _call(self, function: Any, arguments: Any) -> Any:
        if not isinstance(arguments, tuple) or not isinstance(function, Name):
            raise BrokenFileError("its pickle calls something other than a function")
        self.charge(len(arguments))
        return function(*arguments)

    def _load_call_with_keywords(self) -> None:
        self.stack.pop()
        self._load_call()

    def _load_build(self) -> None:
        """Gives a stand-in its state; nothing else is changed."""
        state, target = self.stack.pop(), self.stack[-1]
        if not isinstance(target, StandIn):
            return
        target.built = state
        for part in state if isinstance(state, tuple) else (state,):
            self.charge(1)
            if isinstance(part, dict):
                self.charge(len(part))
                target.state.update(part)

    def _load_setitem(self) -> None:
        value, key = self.stack.pop(), self.stack.pop()
        self._set([key, value])

    def _load_setitems(self) -> None:
        self._set(self.pop_mark())

    def _set(self, values: list[Any]) -> None:
        if isinstance(self.stack[-1], dict):
            self.stack[-1].update(_mapping(values))

    def _load_dict(self) -> None:
        self.stack.append(_mapping(self.pop_mark()))

    def _load_empty_set(self) -> None:
        """A set is a list inside a stand-in, since its elements would have to be hashed."""
        self.stack.append(StandIn("builtins.set", ([],)))

    def _load_additems(self) -> None:
        values, target = self.pop_mark(), self.stack[-1]
        if isinstance(target, StandIn) and target.path == "builtins.set":
            target.arguments[0].extend(values)

    def _load_frozenset(self) -> None:
        self.stack.append(StandIn("builtins.frozenset", (self.pop_mark(),)))

    def _load_frame(self) -> None:
        self.read(8)  # only a hint how much to read ahead


class _BoundedFile:
    """A file of which no more than so many bytes can be read; each must be there."""

    def __init__(self, file: Any, max_bytes: int) -> None:
        self._file, self._left = file, max_bytes

    def read(self, count: int) -> bytes:
        content: bytes = self._file.read(count) if 0 <= count <= self._left else b""
        if len(content) < count or count < 0:
            raise BrokenFileError("its pickle does not end")
        self._left -= count
        return content

    def readline(self) -> bytes:
        line: bytes = self._file.readline(min(self._left, MAX_NAME + (1 << 20)))
        if not line.endswith(b"\n"):
            raise BrokenFileError("its pickle does not end")
        self._left -= len(line)
        return line


def _two(pair: Any) -> tuple[Any, Any]:
    if not isinstance(pair, list | tuple) or len(pair) != 2:
        raise BrokenFileError("its pickle has a dict of other than pairs")
    return pair[0], pair[1]


def _mapping(values: list[Any]) -> dict[Any, Any]:
    """Keys and values in turn as a dict; a key that may be costly to hash stands under its type."""
    return dict(zip(map(_key, values[::2]), values[1::2], strict=True))


def _key(key: Any) -> Any:
    if isinstance(key, str):
        if len(key) > MAX_NAME:
            raise BrokenFileError(f"it has a name of {len(key):,} characters")
        return key
    small = isinstance(key, int) and abs(key) < 1 << 63
    return key if small or isinstance(key, float | None) else type(key).__name__


def _view(storage: Any, offset: Any, shape: Any, stride: Any, dtype: Any = None) -> Tensor:
    """A tensor over a storage, as torch.as_strided makes it, if it lies within the storage."""
    if dtype is not None:
        storage = storage.view(_DTYPES[dtype.path])
    if max(len(shape), len(stride)) > MAX_AXES:
        raise BrokenFileError(f"a tensor of more than {MAX_AXES} axes")
    shape, stride, offset = tuple(map(int, shape)), tuple(map(int, stride)), int(offset)
    if min(offset, *shape, *stride, 0) < 0:
        raise BrokenFileError("a tensor of negative sizes or strides")
    count, limit = math.prod(shape), len(storage)
    last = offset + sum((n - 1) * s for n, s in zip(shape, stride, strict=True))
    if count and (last >= limit or count > max(limit, _MAX_EXPANDED)):
        raise BrokenFileError(
            f"a tensor of {count:.6g} elements goes beyond its storage of {limit:,}"
        )
    return cast(Tensor, storage.as_strided(shape, stride, offset if count else 0))


_INHERITED = (
    *("PROTO", "STOP", "MARK", "POP", "POP_MARK", "DUP", "MEMOIZE", "PUT", "BINPUT", "LONG_BINPUT"),
    *("GET", "BINGET", "LONG_BINGET", "NONE", "NEWTRUE", "NEWFALSE", "INT", "BININT", "BININT1"),
    *("BININT2", "LONG", "LONG1", "LONG4", "FLOAT", "BINFLOAT", "STRING", "BINSTRING", "BINBYTES"),
    *("SHORT_BINSTRING", "UNICODE", "BINUNICODE", "SHORT_BINUNICODE", "BINUNICODE8", "BINBYTES8"),
    *("SHORT_BINBYTES", "EMPTY_TUPLE", "TUPLE", "TUPLE1", "TUPLE2", "TUPLE3", "EMPTY_LIST", "LIST"),
    *("APPEND", "APPENDS", "EMPTY_DICT", "GLOBAL", "STACK_GLOBAL", "BINPERSID", "INST", "OBJ"),
)
_REPLACED: dict[str, Callable[[Any], None]] = {
    **dict.fromkeys(("REDUCE", "NEWOBJ"), PickleReader._load_call),
    "NEWOBJ_EX": PickleReader._load_call_with_keywords,
    "BUILD": PickleReader._load_build,
    "SETITEM": PickleReader._load_setitem,
    "SETITEMS": PickleReader._load_setitems,
    "DICT": PickleReader._load_dict,
    "EMPTY_SET": PickleReader._load_empty_set,
    "ADDITEMS": PickleReader._load_additems,
    "FROZENSET": PickleReader._load_frozenset,
    "FRAME": PickleReader._load_frame,
    "BYTEARRAY8": pickle._Unpickler.dispatch[pickle.BINBYTES8[0]],  # plain bytes will do
}


def _counted(step: Callable[[Any], None]) -> Callable[[Any], None]:
    def run(reader: PickleReader) -> None:
        reader.charge(1)
        step(reader)

    return run


def _refused(opcode: int) -> Callable[[Any], None]:
    def refuse(_: PickleReader) -> None:
        raise BrokenFileError(f"its pickle uses the opcode {bytes([opcode])!r}")

    return refuse


PickleReader.dispatch = {code: _refused(code) for code in range(256)} | {
    ord(getattr(pickle, name)): _counted(
        _REPLACED.get(name) or pickle._Unpickler.dispatch[ord(getattr(pickle, name))]
    )
    for name in (*_INHERITED, *_REPLACED)
}
