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

_MAX_REASON = 160
"""Characters of a reader's message that are shown."""

_MAX_EXPANDED = 1 << 28
"""Elements of a tensor with strides of 0; nothing is allocated for them."""

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
"""Function that returns a flat tensor, whose values lie outside the pickle.

Its arguments are the name of the storage's type, such as "FloatStorage", its key, its number of
elements, and what a pickle of before PyTorch 1.6 has behind these: the view that the tensor is.
"""

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
    """Inside, what readers raise on a file's content becomes a ModelError "`what`: …" on one line.

    Args:
        what: Beginning of the message, such as "checkpoint a.pth cannot be read".
        *more: Exceptions beside `CONTENT_ERRORS` that the reader raises on content.
    """
    try:
        yield
    except (*CONTENT_ERRORS, *more) as error:
        reason = describe(error).removeprefix("InputError: ")[:_MAX_REASON]
        raise ModelError(f"{what}: {reason}") from None


@dataclass(eq=False, repr=False)
class StandIn:
    """Stands for a function or class, or for what a call of it would have returned.

    Nothing of that name is looked up.
    """

    path: str
    """Dotted name of the function or class."""
    arguments: tuple[Any, ...] = ()
    """What it would have been called with; empty for the function or class itself."""
    state: object = None
    """State of the object as pickled, mostly a dict of its attributes."""

    def extend(self, items: list[object]) -> None:
        """Does nothing: what a container of this class would hold is not kept."""

    append = extend


class _Unpickler(pickle._Unpickler):
    """Python's own machine, but for the opcodes that would find, call, change or hash something.

    Args:
        file: File that stands at the first opcode.
        load_storage: Function for tensors whose values lie outside the pickle; None refuses them.
    """

    stack: list[Any]
    """The machine's stack, its top at the end."""
    pop_mark: Callable[[], list[object]]
    """Takes all that lies above the last mark from the stack."""

    def __init__(self, file: BytesIO | mmap, load_storage: LoadStorage | None) -> None:
        super().__init__(file, encoding="latin-1")
        self.stood_for: dict[str, None] = {}
        """Dotted names of what stand-ins stand for, in the order in which they were met."""
        self._load_storage = load_storage
        self._steps_left = MAX_STEPS
        # Only these opcodes, each by the method that handles it, and counted. Any other is a
        # KeyError.
        codes = [getattr(pickle, opcode)[0] for opcode in _OPCODES]
        handlers = {code: getattr(self, self.dispatch[code].__name__) for code in codes}
        self.dispatch = {  # type: ignore[misc]
            code: functools.partial(self._step, handler) for code, handler in handlers.items()
        }

    def _step(self, handler: Callable[[], None], _: object) -> None:
        """Handles one opcode; the machine calls this with itself, to which the handler is bound."""
        self._charge(1)
        try:
            handler()
        except AttributeError:  # of an object on the stack
            raise InputError("its pickle uses an object as one of another kind") from None

    def _charge(self, steps: int) -> None:
        """Counts steps; raises InputError beyond `MAX_STEPS`."""
        self._steps_left -= steps
        if self._steps_left < 0:
            raise InputError(f"its pickle takes more than {MAX_STEPS:,} steps")

    def find_class(self, module: str, name: str) -> StandIn:
        """Returns a stand-in for a function or class; names of Python 2 become those of 3."""
        if len(module) + len(name) > MAX_NAME:
            raise InputError("its pickle has a name without end")
        module = {"__builtin__": "builtins", "copy_reg": "copyreg"}.get(module, module)
        return StandIn(f"{module}.{name}")

    def persistent_load(self, pid: object) -> object:
        """Returns what an id in a torch file names: a storage as a tensor, or a class.

        The source text that the id has of a class is left out.

        Raises:
            InputError: The id names anything else.
        """
        match pid:
            case ("module", module, _, _, *_):
                return module
            case ("storage", StandIn(path), str() | int() as key, _, int(count), *more):
                if self._load_storage is not None:
                    return self._load_storage(path.rpartition(".")[2], str(key), count, more)
        raise InputError("its pickle refers to something outside it")

    def load_empty_set(self) -> None:
        """Opcode EMPTY_SET: pushes a list, as entries of a set would be hashed."""
        self.stack.append([])

    def load_additems(self) -> None:
        """Opcode ADDITEMS: adds all above the mark to the set, which is a list here."""
        items = self.pop_mark()
        self.stack[-1].extend(items)

    def load_setitem(self) -> None:
        """Opcode SETITEM: takes value and key from the stack, for the dict below."""
        value = self.stack.pop()
        key = self.stack.pop()
        self._update([key, value])

    def load_setitems(self) -> None:
        """Opcode SETITEMS: takes keys and values above the mark, in turn, for the dict below."""
        self._update(self.pop_mark())

    def _update(self, keys_and_values: list[object]) -> None:
        """Adds keys and values in turn to the dict on top of the stack."""
        if isinstance(self.stack[-1], dict):  # and not the stand-in of another class
            self.stack[-1].update(self._mapping(keys_and_values))

    def _mapping(self, keys_and_values: list[object]) -> dict[object, object]:
        """Returns keys and values in turn as a dict, with keys by `_cheap_key`."""
        self._charge(len(keys_and_values))
        keys = map(_cheap_key, keys_and_values[::2])
        return dict(zip(keys, keys_and_values[1::2], strict=True))

    def load_build(self) -> None:
        """Opcode BUILD: takes an object's state from the stack, for the object below it.

        A stand-in keeps it. Tensors and plain containers need none.
        """
        state = self.stack.pop()
        if isinstance(self.stack[-1], StandIn):
            self.stack[-1].state = state

    def load_reduce(self) -> None:
        """Opcodes REDUCE and NEWOBJ: takes arguments and a function, and pushes the result."""
        arguments = self.stack.pop()
        function = self.stack.pop()
        self.stack.append(self._result(function, arguments))

    load_newobj = load_reduce

    def _result(self, function: object, arguments: object) -> object:
        """Returns the result of a call if it is a tensor or a plain container, else a stand-in.

        Raises:
            InputError: It is no call of a function with a tuple of arguments.
        """
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


def _cheap_key(key: object) -> object:
    """Returns a key that takes no time to hash: the key itself, or else the name of its type."""
    is_small_int = isinstance(key, int) and abs(key) < 1 << 63
    if is_small_int or isinstance(key, str | float | None):
        return key
    return type(key).__name__


def read_pickle(
    file: BytesIO | mmap, load_storage: LoadStorage | None = None
) -> tuple[object, list[str]]:
    """Returns the content of one pickle, and the names of the functions and classes in it.

    Args:
        file: File that stands at the first opcode, afterwards behind the last. It is in memory or
            mapped: its `read` allocates no more than there is.
        load_storage: Function for tensors whose values lie outside the pickle; None refuses them.

    Raises:
        Exception: The pickle is broken; one of `CONTENT_ERRORS`.
    """
    unpickler = _Unpickler(file, load_storage)
    return unpickler.load(), list(unpickler.stood_for)


def view_of(storage: Tensor, offset: int, shape: Sequence[int], stride: Sequence[int]) -> Tensor:
    """Returns a tensor over the elements of a flat one, without a copy.

    Args:
        storage: Flat tensor.
        offset: Index of the first element in it.
        shape: Shape of the tensor.
        stride: Elements of the storage from one to the next along each axis.

    Raises:
        InputError: It has far more elements than the storage, as with a stride of 0.
        RuntimeError: It reaches beyond the storage, which torch refuses.
    """
    shape = tuple(map(int, shape))
    stride = tuple(map(int, stride))
    count = math.prod(shape)
    most = max(len(storage), _MAX_EXPANDED)
    check_claim(f"a tensor has {count:.6g} elements", count, most)
    # A tensor without elements reads nothing, so its offset does not matter.
    start = int(offset) if count else 0
    return storage.as_strided(shape, stride, start)
