"""Watching a pass of a network operation by operation, for `Split`."""

from __future__ import annotations

import functools
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch.utils._python_dispatch import TorchDispatchMode

from pnpdepth_cli.core.split.structure import is_transparent, map_tensors, tensors_in


@dataclass(eq=False)
class Remembered:
    """Tensors as they were at one time; `copied` where the network changes them in place."""

    output: Any = None
    copied: bool = False

    def hand_back(self) -> Any:
        """What is remembered, in containers of its own, and safe from what is done to it."""
        return map_tensors(
            self.output, lambda _, t: t.clone() if self.copied or t.is_inference() else t
        )


@dataclass(eq=False, kw_only=True)
class Call(Remembered):
    """One call of a submodule that every later pass makes too.

    `kept` is true where the pass hands back `output` instead of running the submodule, `known`
    where that is the output for the arguments at hand. `unread`: its tensors nobody looks into.
    """

    module: nn.Module
    kept: bool = False
    known: bool = False
    unread: frozenset[tuple[str, ...]] = frozenset()

    def remember(self, output: Any) -> None:
        """`output` is what is handed back; of unread tensors only the shape, in one number."""

        def kept(path: tuple[str, ...], tensor: Tensor) -> Tensor:
            if path in self.unread:
                return tensor.new_empty(()).expand(tensor.shape)
            return tensor.clone() if self.copied else tensor

        self.output, self.known = map_tensors(output, kept), True

    def forget(self) -> None:
        """Nothing is remembered, until the submodule has run for other arguments."""
        self.output, self.known = None, False


@dataclass(frozen=True)
class Moment:
    """A time in a watched pass, by how much had happened before it."""

    operations: int
    touches: int
    writes: int


class Watch(TorchDispatchMode):
    """Sees every tensor operation of a pass.

    It marks what depends on z by its storage, notes which operation made which storage and which
    storages are changed in place, notes where a value (not a shape) gets out to Python (`escaped`;
    `data_dependent` where it depends on z), and gives a remembered tensor its own copy just before
    it would be changed in place.
    """

    @classmethod
    def _should_skip_dynamo(cls) -> bool:
        # Torch's own mark for modes that need no guard from torch.compile; the guard would import
        # the whole compiler, a second in every run of the program.
        return False

    def __init__(self, remembered: Iterable[Remembered], *, reads: bool = False) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self._reads: set[int] | None = set() if reads else None
        self.data_dependent = self.escaped = False
        self._operations = 0
        self._touches = 0
        self._writes: list[int] = []  # which operation had made what was changed; 0: none seen here
        self._made: dict[int, int] = {}
        self._marked: set[int] = set()
        self._protected: dict[int, list[Remembered]] = {}
        self._twins: tuple[Tensor, ...] = ()
        self._stale: set[int] = set()  # storages of a twin whose other was changed
        self.torn = False
        for each in remembered:
            self.protect(each)

    def touch(self, tensor: Tensor) -> None:
        """Mark a tensor as depending on z."""
        self._touches += 1
        self._marked.add(_storage(tensor))

    def replace(self, original: Tensor, z: Tensor) -> None:
        """z stands for `original`; `torn` turns true if one is read after the other is changed."""
        self._twins = (original, z)

    def protect(self, remembered: Remembered) -> None:
        """Save these tensors from in-place operations."""
        output = remembered.output
        # Parameters, of which there are many, come as tensors.
        tensors = [output] if isinstance(output, Tensor) else [t for _, t in tensors_in(output)]
        for tensor in tensors:
            self._protected.setdefault(_storage(tensor), []).append(remembered)

    def now(self) -> Moment:
        """This moment, for `can_stand_for`."""
        return Moment(self._operations, self._touches, len(self._writes))

    def can_stand_for(self, since: Moment, given: Any, output: Any) -> bool:
        """True if handing back `output` does all that the call did which began at `since`.

        So it read nothing of z, changed nothing older than itself in place, and its output is
        nothing but tensors that it made, no two of them in one memory.
        """
        if self._marked and not (is_transparent(given) and not self._any_marked(given)):
            self._touches += 1  # a native extension may read its arguments unseen
        made_inside = [_storage(tensor) for _, tensor in tensors_in(output)]
        made_inside = [s for s in made_inside if self._made.get(s, 0) > since.operations]
        if self._touches > since.touches:
            self._marked.update(made_inside)
            return False
        return (
            is_transparent(output)
            and len(set(made_inside)) == sum(1 for _ in tensors_in(output))
            and all(made > since.operations for made in self._writes[since.writes :])
        )

    @contextmanager
    def seeing_escapes(self) -> Iterator[None]:
        """The two ways for values to get out that are no tensor operations are watched too.

        In this thread alone; others may read and write files meanwhile.
        """
        names = ("numpy", "tolist")
        for name in names:
            setattr(Tensor, name, self._noticing(getattr(Tensor, name)))
        try:
            yield
        finally:
            for name in names:
                delattr(Tensor, name)

    def _noticing(self, method: Callable[..., Any]) -> Callable[..., Any]:
        thread = threading.get_ident()

        def wrapped(tensor: Tensor, *args: Any, **kwargs: Any) -> Any:
            if threading.get_ident() == thread:
                self.escaped = True
                self.data_dependent |= self._any_marked(tensor)
            return method(tensor, *args, **kwargs)

        return wrapped

    def __torch_dispatch__(
        self, func: Any, types: Any, args: Sequence[Any] = (), kwargs: Any = None
    ) -> Any:
        kwargs = kwargs or {}
        facts = _facts(func)
        self._operations += 1
        given: list[Tensor] = []
        if not facts.fresh or self._reads is not None:
            given = [t for value in (*args, *kwargs.values()) for t in _tensors(value)]
            self.note_reads(given)
        self.torn |= bool(self._stale) and any(_storage(tensor) in self._stale for tensor in given)
        written = [t for place, name in facts.writes for t in _argument(place, name, args, kwargs)]
        for tensor in written:
            self._before_write(tensor)
        marked = bool(self._marked) and any(map(self._is_marked, given))
        result = func(*args, **kwargs)
        results = {_storage(tensor) for tensor in _tensors(result)}
        made = results - {_storage(tensor) for tensor in given} - {_NO_STORAGE}
        self._made.update(dict.fromkeys(made, self._operations))
        # An address seen before may have been freed and given out again.
        self._marked -= made
        if marked:
            self._touches += 1
            self._marked |= results | {_storage(tensor) for tensor in written}
            self.data_dependent |= facts.escapes
        self.escaped |= facts.escapes
        return result

    def note_reads(self, structure: Any) -> None:
        """These tensors are used, as `was_read` will say; only where reads are wanted."""
        if self._reads is not None:
            self._reads.update(_storage(tensor) for _, tensor in tensors_in(structure))

    def was_read(self, tensor: Tensor) -> bool:
        """True if an operation or somebody else may have looked into the tensor's memory."""
        return self._reads is None or _storage(tensor) in self._reads

    def _before_write(self, tensor: Tensor) -> None:
        storage = _storage(tensor)
        self._writes.append(self._made.get(storage, 0))
        twins = {_storage(twin) for twin in self._twins}
        if storage in twins:
            self._stale |= twins - {storage}
        for remembered in self._protected.pop(storage, []):
            remembered.output = map_tensors(remembered.output, lambda _, t: t.clone())
            remembered.copied = True

    def _any_marked(self, value: Any) -> bool:
        return any(self._is_marked(tensor) for _, tensor in tensors_in(value))

    def _is_marked(self, tensor: Tensor) -> bool:
        # Only z requires gradient, so what does comes from it, by whatever way.
        return tensor.requires_grad or _storage(tensor) in self._marked


_NO_STORAGE = 0
"""Sparse tensors have none; they all share this mark."""


def _storage(tensor: Tensor) -> int:
    try:
        return int(tensor.untyped_storage()._cdata)
    except NotImplementedError:
        return _NO_STORAGE


@dataclass(frozen=True)
class _Facts:
    """What an operation may do.

    writes: the arguments it changes in place, by place and name. fresh: its results are always
    new memory. escapes: values can get out of it to Python.
    """

    writes: tuple[tuple[int, str], ...]
    fresh: bool
    escapes: bool


@functools.cache
def _facts(func: Any) -> _Facts:
    schema = func._schema
    return _Facts(
        writes=tuple(
            (place, argument.name)
            for place, argument in enumerate(schema.arguments)
            if argument.alias_info is not None and argument.alias_info.is_write
        ),
        fresh=func.namespace == "aten" and all(r.alias_info is None for r in schema.returns),
        escapes=torch.Tag.data_dependent_output in func.tags
        or torch.Tag.dynamic_output_shape in func.tags,
    )


def _argument(place: int, name: str, args: Sequence[Any], kwargs: Any) -> list[Tensor]:
    return _tensors(args[place] if place < len(args) else kwargs.get(name))


def _tensors(value: Any) -> list[Tensor]:
    if isinstance(value, Tensor):
        return [value]
    if isinstance(value, list | tuple):
        return [tensor for item in value for tensor in _tensors(item)]
    return []
