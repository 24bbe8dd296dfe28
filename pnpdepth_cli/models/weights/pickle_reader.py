"""Reads a pickle without calling anything that it names.

A pickle is a program for a stack machine, which may call any function. Here Python's own machine
runs it without the opcodes that files of weights do not have. No name is imported: a call of one
gives a tensor, a plain container or an inert `StandIn`.

Time and memory are bounded by the file and by `MAX_STEPS`. torch.load(weights_only=True) is not
used: it allocates the sizes that a file states, hashes what the file holds, and refuses whole
modules.
"""

from __future__ import annotations

import functools
import math
import pickle
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from io import BytesIO
from mmap import mmap
from typing import Any

from torch import Tensor

from pnpdepth_cli.budget import check_claim
from pnpdepth_cli.errors import InputError, ModelError, describe

MAX_STEPS = 3_000_000
"""Opcodes, and entries of dicts; the state dict of 2,000 tensors takes 100,000."""

MAX_NAME = 1_000
"""Characters of a name in a pickle."""

_MAX_EXPANDED = 1 << 28  # elements of a tensor with strides of 0; nothing is allocated for them
_OPCODES = (
    "PROTO",
    "FRAME",
    "STOP",
    "MARK",
    "BINPUT",
    "LONG_BINPUT",
    "MEMOIZE",
    "BINGET",
    "LONG_BINGET",
    "EMPTY_TUPLE",
    "TUPLE",
    "TUPLE1",
    "TUPLE2",
    "TUPLE3",
    "EMPTY_LIST",
    "APPEND",
    "APPENDS",
    "EMPTY_SET",
    "ADDITEMS",
    "EMPTY_DICT",
    "SETITEM",
    "SETITEMS",
    "NONE",
    "NEWTRUE",
    "NEWFALSE",
    "BININT",
    "BININT1",
    "BININT2",
    "LONG1",
    "LONG4",
    "BINFLOAT",
    "BINSTRING",
    "SHORT_BINSTRING",
    "BINUNICODE",
    "SHORT_BINUNICODE",
    "BINBYTES",
    "SHORT_BINBYTES",
    "BINBYTES8",
    "GLOBAL",
    "STACK_GLOBAL",
    "REDUCE",
    "NEWOBJ",
    "BUILD",
    "BINPERSID",
)
"""Opcodes of protocols 2 to 5; no others are done, as some take the memory that a size claims."""

LoadStorage = Callable[[str, str, int, Sequence[object]], Tensor]
"""Function that returns a flat tensor from its type, key and elements, and what follows these."""

CONTENT_ERRORS: tuple[type[Exception], ...] = (
    InputError,
    pickle.UnpicklingError,
    OSError,
    EOFError,
    zipfile.BadZipFile,
    zlib.error,
    struct.error,
    ValueError,
    TypeError,
    LookupError,
    ArithmeticError,
    RuntimeError,
    SyntaxError,
    tokenize.TokenError,  # NumPy evaluates its headers
)
"""What the readers of weights and programs raise on content that is not what it should be."""


@contextmanager
def wrap_content_errors(what: str, *more: type[Exception]) -> Iterator[None]:
    """Turns what readers raise on content, or more, into a ModelError "`what`: …" on one line."""
    try:
        yield
    except (*CONTENT_ERRORS, *more) as error:
        reason = describe(error).removeprefix("InputError: ")[:160]
        raise ModelError(f"{what}: {reason}") from None


@dataclass(eq=False, repr=False)
class StandIn:
    """Stands for a function or class, or for what a call of it would have returned.

    Nothing of that name is looked up; `state` is the state as pickled.
    """

    path: str
    arguments: tuple[Any, ...] = ()
    state: object = None

    def extend(self, items: list[object]) -> None:
        """Forgets what a container of this class would hold."""

    append = extend


class _Unpickler(pickle._Unpickler):
    """Python's own machine, but for the opcodes that would find, call, change or hash something."""

    stack: list[Any]
    pop_mark: Callable[[], list[object]]

    def __init__(self, file: BytesIO | mmap, load_storage: LoadStorage | None) -> None:
        super().__init__(file, encoding="latin-1")
        self.stood_for: dict[str, None] = {}
        self._load_storage = load_storage
        self._left = MAX_STEPS
        codes = [getattr(pickle, opcode)[0] for opcode in _OPCODES]
        functions = {code: getattr(self, self.dispatch[code].__name__) for code in codes}
        self.dispatch = {  # type: ignore[misc]
            code: functools.partial(self._step, function) for code, function in functions.items()
        }

    def _step(self, function: Callable[[], None], _: object) -> None:
        self._charge(1)
        try:
            function()
        except AttributeError:  # of an object on the stack
            raise InputError("its pickle uses an object as one of another kind") from None

    def _charge(self, steps: int) -> None:
        self._left -= steps
        if self._left < 0:
            raise InputError(f"its pickle takes more than {MAX_STEPS:,} steps")

    def find_class(self, module: str, name: str) -> StandIn:
        """The name itself, that of Python 3."""
        if len(module) + len(name) > MAX_NAME:
            raise InputError("its pickle has a name without end")
        module = {"__builtin__": "builtins", "copy_reg": "copyreg"}.get(module, module)
        return StandIn(f"{module}.{name}")

    def persistent_load(self, pid: object) -> object:
        """The storage, or the class without its source text, that the id stands for."""
        match pid:
            case ("module", module, _, _, *_):
                return module
            case ("storage", StandIn(path), str() | int() as key, _, int(count), *more):
                if self._load_storage is not None:
                    return self._load_storage(path.rpartition(".")[2], str(key), count, more)
        raise InputError("its pickle refers to something outside it")

    def load_empty_set(self) -> None:
        self.stack.append([])

    def load_additems(self) -> None:
        self.stack[-1].extend(self.pop_mark())

    def load_setitem(self) -> None:
        self._update([self.stack.pop(-2), self.stack.pop()])

    def load_setitems(self) -> None:
        self._update(self.pop_mark())

    def _update(self, values: list[object]) -> None:
        if isinstance(self.stack[-1], dict):  # and not the stand-in of another class
            self.stack[-1].update(self._mapping(values))

    def _mapping(self, values: list[object]) -> dict[object, object]:
        """Keys and values in turn as a dict; a key that may be costly to hash becomes its type."""
        self._charge(len(values))
        return dict(zip(map(_key, values[::2]), values[1::2], strict=True))

    def load_build(self) -> None:
        state = self.stack.pop()
        if isinstance(self.stack[-1], StandIn):
            self.stack[-1].state = state

    def load_reduce(self) -> None:
        self.stack.append(self._result(self.stack.pop(-2), self.stack.pop()))

    load_newobj = load_reduce

    def _result(self, function: object, arguments: object) -> object:
        """The result of a call if it is a tensor or a plain container, else what stands for it."""
        if not isinstance(arguments, tuple) or not isinstance(function, StandIn):
            raise InputError("its pickle calls something other than a function")
        # Plain containers and tensors are made; nothing is run.
        first = arguments[0] if arguments else None
        match function.path:
            case "collections.OrderedDict" | "collections.defaultdict" | "builtins.dict":
                pairs = first if isinstance(first, list) else []
                return self._mapping([entry for pair in pairs for entry in pair])
            case "builtins.set":
                return first if isinstance(first, list) else []
            case "_codecs.encode" | "builtins.bytes":
                return "" if first is None else first  # text of Latin-1
            case "torch.Size" | "torch.device":
                return first or ()
            case "copyreg._reconstructor" if isinstance(first, StandIn):
                return self._result(first, ())
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


def read_pickle(
    file: BytesIO | mmap, load_storage: LoadStorage | None = None
) -> tuple[object, list[str]]:
    """Returns the content of one pickle, and the functions and classes of its stand-ins.

    A broken pickle raises InputError or what its parts raise.

    Args:
        file: File that stands at the first opcode, afterwards behind the last. It is in memory or
            mapped: its `read` allocates no more than there is.
        load_storage: Function for the persistent ids; None refuses one.
    """
    unpickler = _Unpickler(file, load_storage)
    return unpickler.load(), list(unpickler.stood_for)


def view_of(storage: Tensor, offset: int, shape: Sequence[int], stride: Sequence[int]) -> Tensor:
    """Returns a tensor over a flat one by `as_strided`, which refuses what lies beyond it.

    Raises:
        InputError: It has far more elements than the flat one.
    """
    shape = tuple(map(int, shape))
    stride = tuple(map(int, stride))
    count = math.prod(shape)
    most = max(len(storage), _MAX_EXPANDED)
    check_claim(f"a tensor has {count:.6g} elements", count, most)
    return storage.as_strided(shape, stride, int(offset) if count else 0)
