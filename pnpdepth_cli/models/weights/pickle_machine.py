"""Pickle's stack machine, without its calls.

A pickle is a program that may call anything; this machine calls nothing. It knows tensors and plain
containers, and stands an inert `Instance` for everything else.
"""

from __future__ import annotations

import pickletools
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from torch import Tensor

_LONGEST_PICKLE = 1 << 28  # bytes; a pickle beside its storages is far smaller
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
    """What calling something would have given: its name, its arguments, and what it was built with.

    state: the attributes among that; built: all of it, as pickled.
    """

    path: str
    arguments: tuple[Any, ...] = ()
    state: dict[str, Any] = field(default_factory=dict)
    built: Any = None


class Broken(Exception):
    """A file is not what it should be; the message says how."""


NONSENSE = (
    *(ValueError, TypeError, KeyError, IndexError, AttributeError, RuntimeError),
    *(OverflowError, MemoryError),
)
"""What the machine's own steps, and readers of the numbers beside them, raise at a file that makes
no sense; MemoryError at a length that no file has."""


def brief(reason: object) -> str:
    """The reason on one line that is not too long, since parts of it may come out of the file."""
    return " ".join(str(reason).split())[:160]


class Machine:
    """Pickle's stack machine, without its calls."""

    def __init__(
        self,
        load_storage: Callable[[tuple[Any, ...]], Any],
        *,
        without_tensors: bool = False,
        longest: int = _LONGEST_PICKLE,
    ) -> None:
        self._load_storage, self._without_tensors = load_storage, without_tensors
        self._longest = longest
        self.named: dict[str, None] = {}

    def run(self, file: Any, size: int) -> Any:
        """The object of the pickle that begins here; the file stands behind it."""
        self._stack: list[Any] = []
        self._marks: list[int] = []
        self._memo: dict[int, Any] = {}
        limit = min(size, self._longest)
        start = file.tell()
        for opcode, argument, place in pickletools.genops(file):
            if place is not None and place - start > limit:
                raise Broken("its pickle does not end")
            if opcode.name == "STOP":
                return self._stack.pop()
            self._step(opcode.name, argument)
        raise Broken("its pickle does not end")

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
                raise Broken(f"its pickle uses {name}")
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
        raise Broken("its pickle refers to something outside it")

    def _binpersid(self, _: Any) -> None:
        given = self._stack.pop()
        if isinstance(given, tuple) and given and given[0] == "module":
            self._stack.append(given[1])  # a class with its source text; the text is dropped
        elif isinstance(given, tuple) and len(given) >= 5 and given[0] == "storage":
            self._stack.append(self._load_storage(given))
        else:
            raise Broken("its pickle refers to something outside it")

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
            target.built = state
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
        raise Broken("a tensor without a storage")
    shape, stride = tuple(map(int, shape)), tuple(map(int, stride))
    offset = int(offset)
    empty = any(n == 0 for n in shape)
    reach = sum((n - 1) * s for n, s in zip(shape, stride, strict=True))
    count = 1
    for n in shape:
        count *= n
    bad = offset < 0 or any(n < 0 for n in shape) or any(s < 0 for s in stride)
    if bad or (not empty and (offset + reach >= len(storage) or count > len(storage))):
        raise Broken(f"a tensor of shape {shape} goes beyond its storage of {len(storage)}")
    return storage.as_strided(shape, stride, offset)


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
