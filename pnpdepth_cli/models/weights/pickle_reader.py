"""Reads a pickle without calling anything that it names.

A pickle is a program for a stack machine, which may call any function. Here no name is imported: a
call of one gives a tensor, a plain container or an inert `StandIn`, and opcodes that files of
weights do not have are refused.

Time and memory are bounded by the file and by `MAX_STEPS`. torch.load(weights_only=True) is not
used: it allocates the sizes that a file states, hashes what the file holds, and refuses whole
modules.
"""

from __future__ import annotations

import math
import pickletools
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, cast

from torch import Tensor

from pnpdepth_cli.budget import check_claim

MAX_STEPS = 3_000_000
"""Opcodes, and entries of dicts; the state dict of 2,000 tensors takes 100,000."""

MAX_NAME = 1_000
"""Characters of a name in a pickle."""

_MAX_EXPANDED = 1 << 28  # elements of a tensor with strides of 0; nothing is allocated for them
_CONSTANTS = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False, "EMPTY_TUPLE": ()}
_LITERALS = frozenset(
    {
        *("BININT", "BININT1", "BININT2", "LONG1", "LONG4", "BINFLOAT", "BINSTRING"),
        *("SHORT_BINSTRING", "BINUNICODE", "SHORT_BINUNICODE", "BINBYTES", "SHORT_BINBYTES"),
        *("BINBYTES8",),
    }
)
"""Opcodes of protocols 2 to 5 that put their argument on the stack."""


class BrokenFileError(Exception):
    """A file is not what it should be; the message says how."""


CONTENT_ERRORS = (
    *(BrokenFileError, OSError, EOFError, zipfile.BadZipFile, zlib.error, struct.error),
    *(ValueError, TypeError, LookupError, ArithmeticError, RuntimeError),
    *(SyntaxError, tokenize.TokenError),  # NumPy evaluates its headers
)
"""What the readers of weights and programs raise on content that is not what it should be."""


@dataclass(frozen=True)
class Name:
    """A function or class that the pickle names; it is never looked up."""

    path: str


@dataclass(eq=False, repr=False)
class StandIn:
    """Stands for what a call of `path` would have returned; `state` is its state as pickled."""

    path: str
    arguments: tuple[Any, ...] = ()
    state: Any = None


def read_pickle(
    file: Any, load_storage: Callable[[tuple[Any, ...]], Tensor] | None = None
) -> tuple[object, list[str]]:
    """Returns the content of one pickle, and the functions and classes of its stand-ins.

    A broken pickle raises BrokenFileError or what its parts raise.

    Args:
        file: File that stands at the first opcode, afterwards behind the last. It is in memory or
            mapped: its `read` allocates no more than there is.
        load_storage: Function that returns the flat tensor for a persistent id
            ("storage", type, key, location, elements, ...); None refuses one.
    """
    machine = _Machine(load_storage)
    for opcode, argument, _ in pickletools.genops(file):
        machine.charge(1)
        machine.step(opcode.name, argument)
    return machine.stack.pop(), list(machine.stood_for)


class _Machine:
    """The stack, the marks in it, and the memo of a pickle's program."""

    def __init__(self, load_storage: Callable[[tuple[Any, ...]], Tensor] | None) -> None:
        self.stack: list[Any] = []
        self.stood_for: dict[str, None] = {}
        self._marks: list[int] = []
        self._memo: dict[int, Any] = {}
        self._load_storage = load_storage
        self._left = MAX_STEPS

    def charge(self, steps: int) -> None:
        self._left -= steps
        if self._left < 0:
            raise BrokenFileError(f"its pickle takes more than {MAX_STEPS:,} steps")

    def step(self, opcode: str, argument: Any) -> None:
        """Does what the opcode says; calls are left to `_call`."""
        stack = self.stack
        # One case for each opcode that pickles of weights have.
        match opcode:
            case "BINPUT" | "LONG_BINPUT":
                self._memo[argument] = stack[-1]
            case "MEMOIZE":
                self._memo[len(self._memo)] = stack[-1]
            case "BINGET" | "LONG_BINGET":
                stack.append(self._memo[argument])
            case "MARK":
                self._marks.append(len(stack))
            case "TUPLE":
                stack.append(tuple(self._to_mark()))
            case "TUPLE1" | "TUPLE2" | "TUPLE3":
                count = int(opcode[-1])
                stack[-count:] = [tuple(stack[-count:])]
            case "EMPTY_LIST" | "EMPTY_SET":  # elements of a set would have to be hashed
                stack.append([])
            case "EMPTY_DICT":
                stack.append({})
            case "APPEND":
                self._extend([stack.pop()])
            case "APPENDS" | "ADDITEMS":
                self._extend(self._to_mark())
            case "SETITEM":
                self._set_items([stack.pop(-2), stack.pop()])
            case "SETITEMS":
                self._set_items(self._to_mark())
            case "GLOBAL":
                stack.append(self._name(*argument.split(" ", 1)))
            case "STACK_GLOBAL":
                stack.append(self._name(stack.pop(-2), stack.pop()))
            case "REDUCE" | "NEWOBJ":
                stack.append(self._call(stack.pop(-2), stack.pop()))
            case "BUILD":
                state = stack.pop()
                if isinstance(stack[-1], StandIn):
                    stack[-1].state = state
            case "BINPERSID":
                stack.append(self._persistent(stack.pop()))
            case "PROTO" | "FRAME" | "STOP":
                pass
            case _ if opcode in _LITERALS:
                stack.append(argument)
            case _ if opcode in _CONSTANTS:
                stack.append(_CONSTANTS[opcode])
            case _:
                raise BrokenFileError(f"its pickle has an opcode {opcode}")

    def _to_mark(self) -> list[Any]:
        """What lies above the last mark, taken off the stack."""
        start = self._marks.pop()
        values = self.stack[start:]
        del self.stack[start:]
        return values

    def _extend(self, values: list[object]) -> None:
        if isinstance(self.stack[-1], list):  # and not the stand-in of another class
            self.stack[-1].extend(values)

    def _set_items(self, values: list[object]) -> None:
        if isinstance(self.stack[-1], dict):
            self.stack[-1].update(self._mapping(values))

    def _mapping(self, values: list[object]) -> dict[object, object]:
        """Keys and values in turn as a dict; a key that may be costly to hash becomes its type."""
        self.charge(len(values))
        return dict(zip(map(_key, values[::2]), values[1::2], strict=True))

    def _name(self, module: object, name: object) -> Name:
        """The name itself, that of Python 3."""
        if not isinstance(module, str) or not isinstance(name, str):
            raise BrokenFileError("its pickle has a name that is no text")
        if len(module) + len(name) > MAX_NAME:
            raise BrokenFileError("its pickle has a name without end")
        module = {"__builtin__": "builtins", "copy_reg": "copyreg"}.get(module, module)
        return Name(f"{module}.{name}")

    def _persistent(self, pid: object) -> object:
        """The storage, or the class without its source text, that the id stands for."""
        if isinstance(pid, tuple) and len(pid) >= 4:
            if pid[0] == "module":
                return pid[1]
            if pid[0] == "storage" and self._load_storage is not None:
                return self._load_storage(pid)
        raise BrokenFileError("its pickle refers to something outside it")

    def _call(self, function: object, arguments: Any) -> Any:
        """The result of a call if it is a tensor or a plain container, else what stands for it."""
        if not isinstance(arguments, tuple) or not isinstance(function, Name):
            raise BrokenFileError("its pickle calls something other than a function")
        # Plain containers and tensors are made; nothing is run.
        first = arguments[0] if arguments else None
        match function.path:
            case "collections.OrderedDict" | "collections.defaultdict" | "builtins.dict":
                pairs = first if isinstance(first, list) else []
                return self._mapping([value for key, one in pairs for value in (key, one)])
            case "builtins.set":
                return first if isinstance(first, list) else []
            case "_codecs.encode" | "builtins.bytes":
                return "" if first is None else first  # text of Latin-1
            case "torch.Size" | "torch.device":
                return first or ()
            case "copyreg._reconstructor" if isinstance(first, Name):
                return self._call(first, ())
            case "torch._utils._rebuild_tensor" | "torch._utils._rebuild_tensor_v2":
                return view_of(*arguments[:4])
            case (
                "torch._utils._rebuild_parameter"
                | "torch._utils._rebuild_parameter_with_state"
                | "torch.nn.parameter.Parameter"
            ):
                return first
        # Anything else is remembered by its name.
        self.stood_for.setdefault(function.path)
        return StandIn(function.path, arguments)


def _key(key: object) -> object:
    small = isinstance(key, int) and abs(key) < 1 << 63
    return key if small or isinstance(key, str | float | None) else type(key).__name__


def view_of(storage: Any, offset: Any, shape: Any, stride: Any) -> Tensor:
    """Returns a tensor over a flat one by `as_strided`, which refuses what lies beyond it.

    Raises:
        BrokenFileError: It has far more elements than the flat one.
    """
    shape, stride = tuple(map(int, shape)), tuple(map(int, stride))
    count = math.prod(shape)
    most = max(len(storage), _MAX_EXPANDED)
    check_claim(f"a tensor has {count:.6g} elements", count, most, error=BrokenFileError)
    return cast(Tensor, storage.as_strided(shape, stride, int(offset) if count else 0))
