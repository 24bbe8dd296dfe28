"""Reads a pickle without calling anything that it names.

A pickle is a program that may call any function. `PickleReader` is the standard library's unpickler
in pure Python with an allow-list of its opcodes: every opcode that calls, looks up an attribute or
hashes a value of the file is replaced by one that does not, and an opcode that is not on the list
is an error. Names are never imported. Calls give tensors, plain containers or an inert `StandIn`.

Time and memory are bounded: a pickle has at most `MAX_STEPS` opcodes, where an opcode that copies n
values counts as n, and no opcode reads more bytes than the file has.

One file holds all code that a hostile pickle reaches, so that it can be reviewed in one reading.
"""

from __future__ import annotations

import lzma
import pickle
import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, cast

import torch
from torch import Tensor

MAX_STEPS = 3_000_000
"""Opcodes, and values copied by them. A checkpoint of 2,000 tensors has about 100,000."""

MAX_NAME = 1_000
"""Characters of a name in a pickle."""

_MAX_BYTES = 1 << 28  # of a pickle beside its storages; real ones are far smaller
_MAX_EXPANDED = 1 << 28  # elements of a tensor with strides of 0; nothing is allocated for them
_MAX_AXES = 64
_TENSOR_STEPS = 20
_MAPPINGS = (
    *("collections.OrderedDict", "collections.defaultdict"),
    *("builtins.dict", "__builtin__.dict"),
)
_TENSOR = ("torch._utils._rebuild_tensor", "torch._utils._rebuild_tensor_v2")
_TENSOR_OF_DTYPE = "torch._utils._rebuild_tensor_v3"
_TYPED_TENSOR = "torch._tensor._rebuild_from_type_v2"
_PARAMETERS = ("torch._utils._rebuild_parameter", "torch.nn.parameter.Parameter")
_RECONSTRUCTORS = ("copyreg._reconstructor", "copy_reg._reconstructor")
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
    """Dotted name as in the file."""


@dataclass(eq=False, repr=False)
class StandIn:
    """Stands for what a call would have returned."""

    path: str
    """Dotted name of the function or class that would have been called; "?" if it has none."""
    arguments: tuple[Any, ...] = ()
    """What it would have been called with."""
    state: dict[str, Any] = field(default_factory=dict)
    """The attributes that it would have been given."""
    built: Any = None
    """The whole state as pickled; attributes are among it."""


def brief(reason: object) -> str:
    """Returns the reason on one line of at most 160 characters; parts may come out of the file."""
    text = f"{type(reason).__name__}: {reason}" if type(reason) in READ_ERRORS else str(reason)
    return " ".join(text[:1000].split())[:160]


class PickleReader(pickle._Unpickler):
    """Reads one pickle without running anything that is in it.

    Args:
        file: Stands at the first opcode; afterwards behind the last.
        load_storage: Returns the flat tensor (or any stand-in) for a persistent id
            ("storage", type, key, location, elements, ...).
        max_bytes: The most bytes that the pickle may have.
        skip_tensors: Tensors are None instead, as when their storages cannot be read yet.
    """

    if TYPE_CHECKING:  # attributes of the standard unpickler that its type stubs leave out
        stack: list[Any]
        readline: Callable[[], bytes]
        pop_mark: Callable[[], list[Any]]

    def __init__(
        self,
        file: Any,
        load_storage: Callable[[tuple[Any, ...]], Any],
        *,
        max_bytes: int = _MAX_BYTES,
        skip_tensors: bool = False,
    ) -> None:
        super().__init__(_BoundedFile(file, max_bytes), encoding="latin-1")
        self._load_storage, self._skip_tensors = load_storage, skip_tensors
        self._steps = MAX_STEPS
        self.named: dict[str, None] = {}
        self.has_stand_ins = False

    def read_object(self) -> Any:
        """Returns the pickled object.

        Raises:
            BrokenFileError: The pickle is none, or would do more than hold data.
            Exception: Another of READ_ERRORS.
        """
        return self.load()

    def charge(self, steps: int) -> None:
        """Counts the steps. Raises BrokenFileError when too many have been made."""
        self._steps -= steps
        if self._steps < 0:
            raise BrokenFileError(f"its pickle takes more than {MAX_STEPS:,} steps")

    def find_class(self, module: str, name: str) -> Name:
        """Returns the name itself; nothing is imported."""
        if len(module) + len(name) > MAX_NAME:
            raise BrokenFileError("its pickle has a name without end")
        path = f"{module}.{name}"
        self.named.setdefault(path)
        return Name(path)

    def persistent_load(self, pid: Any) -> Any:
        """Returns the storage, or the class without its source text, that the id stands for."""
        if isinstance(pid, tuple) and len(pid) > 1 and pid[0] == "module":
            return pid[1]
        if isinstance(pid, tuple) and len(pid) >= 5 and pid[0] == "storage":
            return self._load_storage(pid)
        raise BrokenFileError("its pickle refers to something outside it")

    def load_reduce(self) -> None:
        """Function and arguments → what stands for the result."""
        arguments, function = self.stack.pop(), self.stack.pop()
        self.stack.append(self._called(function, arguments))

    def load_newobj_ex(self) -> None:
        """As `load_reduce`, without the keyword arguments."""
        self.stack.pop()
        self.load_reduce()

    def load_inst(self) -> None:
        """As `load_reduce`, the name on two lines and the arguments since the mark."""
        module, name = (self.readline()[:-1].decode("ascii") for _ in range(2))
        self.stack.append(self._called(self.find_class(module, name), tuple(self.pop_mark())))

    def load_obj(self) -> None:
        """As `load_reduce`, function and arguments since the mark."""
        function, *arguments = self.pop_mark()
        self.stack.append(self._called(function, tuple(arguments)))

    def load_build(self) -> None:
        """A stand-in keeps its state; nothing else is changed."""
        state = self.stack.pop()
        target = self.stack[-1]
        if isinstance(target, StandIn):
            target.built = state
            for part in state if isinstance(state, tuple) else (state,):
                self.charge(1)
                if isinstance(part, dict):
                    self.charge(len(part))
                    target.state.update(part)

    def load_append(self) -> None:
        """A list grows by a value; a stand-in, such as of a list's subclass, stays as it is."""
        value = self.stack.pop()
        self._extend([value])

    def load_appends(self) -> None:
        """A list grows by the values since the mark."""
        self._extend(self.pop_mark())

    def load_setitem(self) -> None:
        """A dict gets an entry."""
        value, key = self.stack.pop(), self.stack.pop()
        self._update([key, value])

    def load_setitems(self) -> None:
        """A dict gets the keys and values since the mark."""
        self._update(self.pop_mark())

    def load_dict(self) -> None:
        """The keys and values since the mark as a dict."""
        self.stack.append(_pairs(self.pop_mark()))

    def load_empty_set(self) -> None:
        """A set is a stand-in, since its elements would have to be hashed."""
        self.stack.append(StandIn("builtins.set", ([],)))

    def load_additems(self) -> None:
        """A set grows by the values since the mark."""
        values = self.pop_mark()
        target = self.stack[-1]
        if isinstance(target, StandIn) and target.path == "builtins.set":
            self._extend(values, target.arguments[0])

    def load_frozenset(self) -> None:
        """The values since the mark as a stand-in of a frozenset."""
        self.stack.append(StandIn("builtins.frozenset", (self.pop_mark(),)))

    def _extend(self, values: list[Any], target: Any = None) -> None:
        target = self.stack[-1] if target is None else target
        if isinstance(target, list):
            target.extend(values)

    def _update(self, values: list[Any]) -> None:
        if isinstance(self.stack[-1], dict):
            self.stack[-1].update(_pairs(values))

    def _called(self, function: Any, arguments: Any) -> Any:
        """What stands for a call's result; only tensors and plain containers are made."""
        if not isinstance(arguments, tuple):
            raise BrokenFileError("its pickle calls without arguments")
        path = function.path if isinstance(function, Name) else "?"
        if path in _MAPPINGS:
            return self._mapping(arguments)
        if path == "torch.Size":
            return arguments[0] if arguments else ()
        if path in _RECONSTRUCTORS:
            inner = arguments[0]
            return self._stand_in(inner.path if isinstance(inner, Name) else "?", ())
        if path in _TENSOR or path == _TENSOR_OF_DTYPE:
            self.charge(_TENSOR_STEPS)
            dtype = arguments[6] if path == _TENSOR_OF_DTYPE else None
            storage, offset, shape, stride = arguments[:4]
            return None if self._skip_tensors else _view(storage, offset, shape, stride, dtype)
        if path == _TYPED_TENSOR:  # a parameter or tensor with attributes of its own
            return self._called(arguments[0], arguments[2])
        if path.startswith(_PARAMETERS):
            return arguments[0]
        return self._stand_in(path, arguments)

    def _mapping(self, arguments: tuple[Any, ...]) -> dict[Any, Any]:
        pairs = arguments[0] if arguments and isinstance(arguments[0], list) else []
        self.charge(len(pairs))
        return _pairs([value for key_and_value in pairs for value in _two(key_and_value)])

    def _stand_in(self, path: str, arguments: tuple[Any, ...]) -> StandIn:
        self.has_stand_ins = True
        return StandIn(path, arguments)


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
        raise BrokenFileError("its pickle has a dict that is none")
    return pair[0], pair[1]


def _pairs(values: list[Any]) -> dict[Any, Any]:
    """Keys and values in turn as a dict."""
    return dict(zip(map(_key, values[::2]), values[1::2], strict=True))


def _key(key: Any) -> Any:
    """A key that can be hashed and printed at no cost: any other stands under its type."""
    if isinstance(key, str):
        if len(key) > MAX_NAME:
            raise BrokenFileError(f"it has a name of {len(key):,} characters")
        return key
    small = isinstance(key, int) and abs(key) < 1 << 63
    return key if small or isinstance(key, float | None) else type(key).__name__


def _view(storage: Any, offset: Any, shape: Any, stride: Any, dtype: Any) -> Tensor:
    """A tensor over a storage, as torch.as_strided makes it, if it lies within the storage."""
    if not isinstance(storage, Tensor):
        raise BrokenFileError("a tensor without a storage")
    if dtype is not None:
        if not isinstance(dtype, Name) or dtype.path not in _DTYPES:
            raise BrokenFileError("a tensor of no type")
        storage = storage.view(_DTYPES[dtype.path])
    if max(len(shape), len(stride)) > _MAX_AXES:
        raise BrokenFileError(f"a tensor of more than {_MAX_AXES} axes")
    shape, stride = tuple(map(int, shape)), tuple(map(int, stride))
    offset = int(offset)
    if offset < 0 or any(n < 0 for n in (*shape, *stride)):
        raise BrokenFileError("a tensor of negative sizes or strides")
    if 0 in shape:
        return cast(Tensor, storage.as_strided(shape, stride, 0))
    reach = sum((n - 1) * s for n, s in zip(shape, stride, strict=True))
    count = 1
    for n in shape:
        count *= n
    if offset + reach >= len(storage) or count > max(len(storage), _MAX_EXPANDED):
        raise BrokenFileError(
            f"a tensor of {count:.6g} elements goes beyond its storage of {len(storage):,}"
        )
    return cast(Tensor, storage.as_strided(shape, stride, offset))


_INHERITED = (
    *("PROTO", "FRAME", "STOP", "MARK", "POP", "POP_MARK", "DUP", "MEMOIZE"),
    *("PUT", "BINPUT", "LONG_BINPUT", "GET", "BINGET", "LONG_BINGET"),
    *("NONE", "NEWTRUE", "NEWFALSE", "INT", "BININT", "BININT1", "BININT2", "LONG", "LONG1"),
    *("LONG4", "FLOAT", "BINFLOAT", "STRING", "BINSTRING", "SHORT_BINSTRING", "UNICODE"),
    *("BINUNICODE", "SHORT_BINUNICODE", "BINUNICODE8", "BINBYTES", "SHORT_BINBYTES", "BINBYTES8"),
    *("EMPTY_TUPLE", "TUPLE", "TUPLE1", "TUPLE2", "TUPLE3", "EMPTY_LIST", "LIST", "EMPTY_DICT"),
    *("GLOBAL", "STACK_GLOBAL", "BINPERSID"),  # these go through find_class, persistent_load
)
_REPLACED: dict[str, Callable[[Any], None]] = {
    "REDUCE": PickleReader.load_reduce,
    "NEWOBJ": PickleReader.load_reduce,
    "NEWOBJ_EX": PickleReader.load_newobj_ex,
    "INST": PickleReader.load_inst,
    "OBJ": PickleReader.load_obj,
    "BUILD": PickleReader.load_build,
    "APPEND": PickleReader.load_append,
    "APPENDS": PickleReader.load_appends,
    "SETITEM": PickleReader.load_setitem,
    "SETITEMS": PickleReader.load_setitems,
    "DICT": PickleReader.load_dict,
    "EMPTY_SET": PickleReader.load_empty_set,
    "ADDITEMS": PickleReader.load_additems,
    "FROZENSET": PickleReader.load_frozenset,
    "BYTEARRAY8": pickle._Unpickler.dispatch[pickle.BINBYTES8[0]],  # plain bytes will do
}


def _refused(opcode: int) -> Callable[[PickleReader], None]:
    def refuse(reader: PickleReader) -> None:
        raise BrokenFileError(f"its pickle uses the opcode {bytes([opcode])!r}")

    return refuse


def _counted(step: Callable[[Any], None]) -> Callable[[Any], None]:
    def run(reader: PickleReader) -> None:
        reader.charge(1)
        step(reader)

    return run


PickleReader.dispatch = {opcode: _refused(opcode) for opcode in range(256)} | {
    getattr(pickle, name)[0]: _counted(step)
    for name, step in (
        *((name, pickle._Unpickler.dispatch[getattr(pickle, name)[0]]) for name in _INHERITED),
        *_REPLACED.items(),
    )
}
