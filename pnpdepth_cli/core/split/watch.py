"""Watching a pass of a network operation by operation, for `Split`.

Two modes of torch are active in this thread and this pass only. A dispatch mode sees every tensor
operation. A torch function mode sees `Tensor.numpy` and the like, by which values reach Python
without an operation. It is off within torch's fused transformer layers, which would otherwise take
other kernels, and so other bits, than in later passes.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext

import torch
from torch import Tensor, nn, overrides
from torch._ops import OpOverload
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode

from pnpdepth_cli.core.split.tensors import SavedTensors, is_transparent, map_tensors, tensors_in

_ESCAPES = (Tensor.numpy, Tensor.tolist, Tensor.__array__, Tensor.__dlpack__)
"""Methods that give values to Python and are no tensor operations."""

_FUSED = (
    nn.MultiheadAttention.forward,
    nn.TransformerEncoder.forward,
    nn.TransformerEncoderLayer.forward,
)
"""Torch's own forwards that use a fused kernel only where no torch function mode is active."""


Moment = tuple[int, int, int]
"""A time in a watched pass: the operations, results that depend on z, and writes before it."""


class Watch(TorchDispatchMode):
    """Sees every tensor operation of a pass, by the storages of its tensors.

    It tracks which tensors depend on z, which operation created which storage, and which storages
    change in place. A saved tensor is cloned just before it would be changed in place.
    """

    escaped: bool
    """Whether a value of a tensor (not a shape) reached Python, which may branch on it."""
    data_dependent: bool  # whether such a value depended on z
    torn: bool  # whether z or the tensor it stands for was read after the other had been changed

    @classmethod
    def _should_skip_dynamo(cls) -> bool:
        # Torch's own mark for modes that need no guard from torch.compile; the guard would import
        # the whole compiler, a second in every run of the program.
        return False

    def __init__(self, saved: Iterable[SavedTensors], *, escapes: bool) -> None:
        """Begins with all counts at 0; sets and keys below are numbers of storages.

        Args:
            saved: Tensors to protect from in-place operations.
            escapes: Whether values that reach Python are noted.
        """
        super().__init__()  # type: ignore[no-untyped-call]
        self.data_dependent = False
        self.escaped = False
        self.torn = False
        self._operations = 0
        self._touches = 0
        self._writes: list[int] = []  # per change in place, the storage's creator; 0: none
        self._created: dict[int, int] = {}  # operation that created a storage
        self._marked: set[int] = set()  # storages that depend on z
        self._protected: dict[int, list[SavedTensors]] = {}
        self._twins: tuple[Tensor, ...] = ()  # z, and the tensor of the network it stands for
        self._stale: set[int] = set()  # the storage of one twin after the other was changed
        self._function_mode = _EscapeMode(self)
        self._notes_escapes = escapes
        self._sees_escapes = False
        for tensors in saved:
            self.protect(tensors)

    def injected(self, z: Tensor, original: Tensor | None) -> None:
        """Notes that the network goes on with z, in place of `original` if that exists."""
        self._touches += 1
        self._marked.add(_storage(z))
        if original is not None:
            self._twins = (original, z)

    def protect(self, saved: SavedTensors) -> None:
        """Protects these tensors from in-place operations."""
        for _, tensor in tensors_in(saved.value):
            self._protected.setdefault(_storage(tensor), []).append(saved)

    def now(self) -> Moment:
        """Returns this moment, for `can_stand_for`."""
        return self._operations, self._touches, len(self._writes)

    def can_stand_for(self, since: Moment, inputs: object, output: object) -> bool:
        """Whether returning `output` does all that the call did which began at `since`.

        So it did not depend on z, changed nothing older than itself in place, and its output
        consists of tensors that it created, no two of them in the same memory.
        """
        operations, touches, writes = since
        marked_input = any(self._is_marked(tensor) for _, tensor in tensors_in(inputs))
        if self._marked and (marked_input or not is_transparent(inputs)):
            self._touches += 1  # a native extension may read its arguments unnoticed
        created_inside = [_storage(tensor) for _, tensor in tensors_in(output)]
        created_inside = [s for s in created_inside if self._created.get(s, 0) > operations]
        if self._touches > touches:
            self._marked.update(created_inside)
            return False
        return (
            is_transparent(output)
            and len(set(created_inside)) == sum(1 for _ in tensors_in(output))
            and all(created > operations for created in self._writes[writes:])
        )

    @contextmanager
    def seeing_escapes_of(self, module: nn.Module) -> Iterator[None]:
        """Watches the methods that give values to Python, too, but not in torch's fused layers."""
        seen_outside = self._sees_escapes
        is_fused = getattr(type(module), "forward", None) in _FUSED
        self._sees_escapes = self._notes_escapes and not is_fused
        # The function mode is entered, or left for a while, where that differs from outside.
        innermost = overrides._get_current_function_mode()  # type: ignore[no-untyped-call]
        change: AbstractContextManager[object] = nullcontext()
        if self._sees_escapes and not seen_outside:
            change = self._function_mode
        elif seen_outside and not self._sees_escapes and innermost is self._function_mode:
            change = overrides._pop_mode_temporarily()
        try:
            with change:
                yield
        finally:
            self._sees_escapes = seen_outside

    def note_escape(self, tensor: Tensor) -> None:
        """Notes that values of the tensor reach Python."""
        self.escaped = True
        self.data_dependent |= self._is_marked(tensor)

    def __torch_dispatch__(
        self,
        func: OpOverload,
        types: object,
        args: Sequence[object] = (),
        kwargs: Mapping[str, object] | None = None,
    ) -> object:
        kwargs = kwargs or {}
        writes, escapes = _facts(func)
        escapes = escapes and self._notes_escapes
        self._operations += 1
        inputs = [tensor for _, tensor in tensors_in((*args, *kwargs.values()))]
        self.torn |= bool(self._stale) and any(_storage(tensor) in self._stale for tensor in inputs)
        # Saved tensors are cloned before the operation changes them.
        written = [
            tensor
            for index, name in writes
            for _, tensor in tensors_in(args[index] if index < len(args) else kwargs.get(name))
        ]
        for tensor in written:
            self._before_write(tensor)
        marked = bool(self._marked) and any(map(self._is_marked, inputs))
        result = func(*args, **kwargs)
        # New memory among its results belongs to this operation.
        results = {_storage(tensor) for _, tensor in tensors_in(result)}
        created = results - {_storage(tensor) for tensor in inputs} - {_NO_STORAGE}
        self._created.update(dict.fromkeys(created, self._operations))
        # An address seen before may have been freed and reused.
        self._marked -= created
        # What an operation makes of z, or writes, depends on z.
        if marked:
            self._touches += 1
            self._marked |= results | {_storage(tensor) for tensor in written}
            self.data_dependent |= escapes
        self.escaped |= escapes
        return result

    def _before_write(self, tensor: Tensor) -> None:
        """Notes a change in place, and clones the saved tensors that it would change."""
        storage = _storage(tensor)
        self._writes.append(self._created.get(storage, 0))
        twins = {_storage(twin) for twin in self._twins}
        if storage in twins:
            self._stale |= twins - {storage}
        for saved in self._protected.pop(storage, []):
            saved.value = map_tensors(saved.value, lambda _, t: t.clone())
            saved.copied = True

    def _is_marked(self, tensor: Tensor) -> bool:
        # Only z requires gradient, so a tensor that does was computed from it.
        return tensor.requires_grad or _storage(tensor) in self._marked


class _EscapeMode(TorchFunctionMode):
    """Sees the methods by which values reach Python without a tensor operation."""

    def __init__(self, watch: Watch) -> None:
        super().__init__()
        self._watch = watch

    def __torch_function__(
        self,
        func: Callable[..., object],
        types: object,
        args: Sequence[object] = (),
        kwargs: Mapping[str, object] | None = None,
    ) -> object:
        if func in _ESCAPES and isinstance(args[0], Tensor):
            self._watch.note_escape(args[0])
        return func(*args, **(kwargs or {}))


_NO_STORAGE = 0  # the mark of sparse tensors, which have no storage


def _storage(tensor: Tensor) -> int:
    """A number that tensors in the same memory share."""
    try:
        return int(tensor.untyped_storage()._cdata)
    except NotImplementedError:
        return _NO_STORAGE


@functools.cache
def _facts(func: OpOverload) -> tuple[list[tuple[int, str]], bool]:
    """Index and name of the arguments that an operation changes in place; whether values escape.

    They do where it gives them, or shapes that depend on them, to Python.
    """
    writes = [
        (index, argument.name)
        for index, argument in enumerate(func._schema.arguments)
        if argument.alias_info and argument.alias_info.is_write
    ]
    tags = (torch.Tag.data_dependent_output, torch.Tag.dynamic_output_shape)
    return writes, any(tag in func.tags for tag in tags)
