"""Reads a pickle without calling anything that it names.

A pickle is a program that may call any function. `PickleReader` is the standard library's unpickler
in pure Python. Names are never imported: a call of one gives a tensor, a plain container or an
inert `StandIn`. Opcodes that call, set attributes or hash values of the file are replaced.

Time and memory are bounded by the file and by `MAX_STEPS`. torch.load(weights_only=True) is not
used: it believes the sizes that a file states, hashes what the file holds, and refuses whole
modules.
"""

from __future__ import annotations

import math
import pickle
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, cast

import torch
from torch import Tensor

MAX_STEPS = 6_000_000
"""Reads from the file, about two per opcode, and values copied; 2,000 tensors take 200,000."""

MAX_NAME = 1_000
"""Characters of a name in a pickle."""

MAX_AXES = 64

PLAIN_NAMES = re.compile(
    r"torch\.(\w+Storage|Size|device|storage\.UntypedStorage|b?float\d+|u?int\d+|bool|complex\d+"
    r"|_utils\._rebuild_(tensor(_v[23])?|parameter(_with_state)?)|nn\.parameter\.Parameter"
    r"|_tensor\._rebuild_from_type_v2|Tensor)|collections\.(OrderedDict|defaultdict)"
)
"""What files of nothing but tensors name."""

_MAX_EXPANDED = 1 << 28  # elements of a tensor with strides of 0; nothing is allocated for them
_DTYPES = {str(value): value for value in vars(torch).values() if isinstance(value, torch.dtype)}


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
    """Stands for what a call of `path` would have returned; `state` is its state as pickled."""

    path: str
    arguments: tuple[Any, ...] = ()
    state: Any = None

    def append(self, value: Any) -> None:
        """Does nothing, as for a subclass of list."""

    extend = append


def brief(error: Exception) -> str:
    """Returns the error on one line of at most 160 characters; parts may come out of the file."""
    kind = "" if isinstance(error, BrokenFileError) else f"{type(error).__name__}: "
    return " ".join(f"{kind}{error}"[:1000].split())[:160]


class PickleReader(pickle._Unpickler):
    """Reads one pickle by `load()`, which raises BrokenFileError or what its parts raise.

    named: afterwards all functions and classes that the pickle names.

    Args:
        file: Stands at the first opcode; afterwards behind the last.
        load_storage: Returns the flat tensor for a persistent id
            ("storage", type, key, location, elements, ...); None refuses one.
    """

    stack: list[Any]  # left out by the stubs of the standard library, like the next two
    read: Callable[[int], bytes]
    pop_mark: Callable[[], list[Any]]

    def __init__(
        self, file: Any, load_storage: Callable[[tuple[Any, ...]], Tensor] | None = None
    ) -> None:
        self._meter = _Meter(file)
        super().__init__(self._meter, encoding="latin-1")
        self._load_storage = load_storage
        self.named: dict[str, None] = {}

    def find_class(self, module: str, name: str) -> Name:
        """Returns the name itself, that of Python 3; nothing is imported."""
        if len(module) + len(name) > MAX_NAME:
            raise BrokenFileError("its pickle has a name without end")
        module = {"__builtin__": "builtins", "copy_reg": "copyreg"}.get(module, module)
        self.named.setdefault(f"{module}.{name}")
        return Name(f"{module}.{name}", self._called)

    def persistent_load(self, pid: Any) -> Any:
        """Returns the storage, or the class without its source text, that the id stands for."""
        kind = pid[0] if isinstance(pid, tuple) and len(pid) >= 4 else None
        if kind == "module":
            return pid[1]
        if kind != "storage" or self._load_storage is None:
            raise BrokenFileError("its pickle refers to something outside it")
        return self._load_storage(pid)

    def _called(self, path: str, arguments: tuple[Any, ...]) -> Any:
        """What stands for a call's result; only tensors and plain containers are made."""
        first = arguments[0] if arguments else None
        match path:
            case "collections.OrderedDict" | "collections.defaultdict" | "builtins.dict":
                pairs = first if isinstance(first, list) else []
                return self._mapping([value for key, one in pairs for value in (key, one)])
            case "builtins.set" | "builtins.frozenset":
                return first if isinstance(first, list) else []
            case "_codecs.encode" | "builtins.bytes" | "builtins.bytearray":
                return "" if first is None else first  # text of Latin-1
            case "torch.Size":
                return first or ()
            case "copyreg._reconstructor":
                return StandIn(getattr(first, "path", "?"))
            case "torch._utils._rebuild_tensor" | "torch._utils._rebuild_tensor_v2":
                return view_of(*arguments[:4])
            case "torch._utils._rebuild_tensor_v3":  # of a dtype that storages do not name
                storage, offset, shape, stride = arguments[:4]
                return view_of(storage, offset, shape, stride, arguments[6])
            case "torch._tensor._rebuild_from_type_v2":  # it has attributes of its own
                return self._call(first, arguments[2])
            case _ if path.startswith("torch._utils._rebuild_parameter"):
                return first
            case "torch.nn.parameter.Parameter":
                return first
        return StandIn(path, arguments)

    def _load_call(self) -> None:
        arguments, function = self.stack.pop(), self.stack.pop()
        self.stack.append(self._call(function, arguments))

    def _call(self, function: Any, arguments: Any) -> Any:
        if not isinstance(arguments, tuple) or not isinstance(function, Name):
            raise BrokenFileError("its pickle calls something other than a function")
        self._meter.charge(len(arguments))
        return function(*arguments)

    def _load_build(self) -> None:
        state, target = self.stack.pop(), self.stack[-1]
        if isinstance(target, StandIn):
            target.state = state

    def _set_items(self, values: list[Any]) -> None:
        if isinstance(self.stack[-1], dict):
            self.stack[-1].update(self._mapping(values))

    def _mapping(self, values: list[Any]) -> dict[Any, Any]:
        """Keys and values in turn as a dict; a key that may be costly to hash becomes its type."""
        self._meter.charge(len(values))
        return dict(zip(map(_key, values[::2]), values[1::2], strict=True))


class _Meter:
    """A file that is read in so many steps at most; what is asked for must be there."""

    def __init__(self, file: Any) -> None:
        self._file, self._left = file, MAX_STEPS

    def charge(self, steps: int) -> None:
        self._left -= steps
        if self._left < 0:
            raise BrokenFileError(f"its pickle takes more than {MAX_STEPS:,} steps")

    def read(self, count: int) -> bytes:
        self.charge(1)
        content: bytes = self._file.read(count)
        if len(content) != count:
            raise BrokenFileError("its pickle does not end")
        return content

    def readline(self) -> bytes:
        self.charge(1)
        line: bytes = self._file.readline(1 << 20)
        return line


def _key(key: Any) -> Any:
    if isinstance(key, str) and len(key) > MAX_NAME:
        raise BrokenFileError(f"it has a name of {len(key):,} characters")
    small = isinstance(key, int) and abs(key) < 1 << 63
    return key if small or isinstance(key, str | float | None) else type(key).__name__


def view_of(storage: Any, offset: Any, shape: Any, stride: Any, dtype: Any = None) -> Tensor:
    """Returns a tensor over a flat one, as torch.as_strided makes it, if it lies within it.

    Raises:
        BrokenFileError: It lies beyond, or has more elements than the strides may repeat.
    """
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


def _opcodes() -> dict[int, Callable[[Any], Any]]:
    """Those of protocol 5, but none of extensions, which are imported, or of outside buffers."""
    inherited = pickle._Unpickler.dispatch
    own = {code: step for code, step in inherited.items() if code <= pickle.BYTEARRAY8[0]}
    for extension in (pickle.EXT1, pickle.EXT2, pickle.EXT4):
        del own[extension[0]]
    replaced: dict[bytes, Callable[[Any], Any]] = {
        **dict.fromkeys((pickle.REDUCE, pickle.NEWOBJ), PickleReader._load_call),
        pickle.NEWOBJ_EX: lambda reader: (reader.stack.pop(), reader._load_call()),
        pickle.BUILD: PickleReader._load_build,
        pickle.SETITEM: lambda reader: reader._set_items(
            [reader.stack.pop(-2), reader.stack.pop()]
        ),
        pickle.SETITEMS: lambda reader: reader._set_items(reader.pop_mark()),
        pickle.DICT: lambda reader: reader.stack.append(reader._mapping(reader.pop_mark())),
        pickle.FRAME: lambda reader: reader.read(8),  # only a hint how much to read ahead
        # A set is a list, since its elements would have to be hashed; bytes will do for bytearray.
        pickle.EMPTY_SET: inherited[pickle.EMPTY_LIST[0]],
        pickle.ADDITEMS: inherited[pickle.APPENDS[0]],
        pickle.FROZENSET: inherited[pickle.LIST[0]],
        pickle.BYTEARRAY8: inherited[pickle.BINBYTES8[0]],
    }
    return own | {code[0]: step for code, step in replaced.items()}


PickleReader.dispatch = _opcodes()
