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
from typing import NamedTuple

import torch
from torch import Tensor, nn, overrides
from torch._ops import OpOverload
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode

from pnpdepth_cli.core.split.tensors import (
    NO_STORAGE,
    SavedTensors,
    is_transparent,
    map_tensors,
    storage_of,
    tensors_in,
)

_ESCAPES = (Tensor.numpy, Tensor.tolist, Tensor.__array__, Tensor.__dlpack__)
"""Methods that give values to Python and are no tensor operations."""

_FUSED = (
    nn.MultiheadAttention.forward,
    nn.TransformerEncoder.forward,
    nn.TransformerEncoderLayer.forward,
)
"""Torch's own forwards that use a fused kernel only where no torch function mode is active."""


class Moment(NamedTuple):
    """A time in a watched pass, by how much has happened before it."""

    operations: int  # number of tensor operations
    touches: int  # number of those, and of calls, that may have read z
    writes: int  # number of changes in place


class Watch(TorchDispatchMode):
    """Sees every tensor operation of a pass, by the storages of its tensors.

    It tracks which tensors depend on z, which operation created which storage, and which storages
    change in place. A saved tensor is cloned just before it would be changed in place.
    """

    escaped: bool
    """Whether a value of a tensor (not a shape) reached Python, which may branch on it."""
    data_dependent: bool
    """Whether such a value depended on z."""
    torn: bool
    """Whether z or the tensor it stands for was read after the other had been changed in place."""

    @classmethod
    def _should_skip_dynamo(cls) -> bool:
        """False: torch's own mark for modes that need no guard from torch.compile.

        The guard would import the whole compiler, a second in every run of the program.
        """
        return False

    def __init__(self, saved: Iterable[SavedTensors], *, escapes: bool) -> None:
        """A watch of a pass that has not begun.

        Args:
            saved: Tensors to protect from in-place operations.
            escapes: Whether values that reach Python are noted.
        """
        super().__init__()  # type: ignore[no-untyped-call]
        self.data_dependent = False
        self.escaped = False
        self.torn = False
        self._operations = 0  # tensor operations so far, so that each has a number from 1
        self._touches = 0  # operations and calls so far that may have read z
        self._writes: list[int] = []
        """For each change in place, the number of the operation that created what is changed; 0:
        it is older than the pass."""
        # By storage, as `storage_of` numbers it:
        self._created: dict[int, int] = {}  # number of the operation that created it
        self._marked: set[int] = set()  # those that depend on z
        self._protected: dict[int, list[SavedTensors]] = {}  # what is cloned before it is changed
        self._twins: tuple[Tensor, ...] = ()  # z, and the tensor of the network it stands for
        self._stale: set[int] = set()  # the storage of one twin after the other was changed
        self._function_mode = _EscapeMode(self)
        self._notes_escapes = escapes  # whether values that reach Python matter
        self._sees_escapes = False  # whether they are noted at the moment: the function mode is on
        for tensors in saved:
            self.protect(tensors)

    def note_injection(self, z: Tensor, original: Tensor | None) -> None:
        """Notes that the cut layer gives z in place of its own output.

        Args:
            z: The tensor that it gives.
            original: Its own output, for which z stands; None if the layer did not run.
        """
        self._touches += 1  # from here on the network reads z
        self._marked.add(storage_of(z))
        if original is not None:
            self._twins = (original, z)

    def protect(self, saved: SavedTensors) -> None:
        """Protects these tensors: they are cloned before an operation changes them in place."""
        for _, tensor in tensors_in(saved.value):
            self._protected.setdefault(storage_of(tensor), []).append(saved)

    def now(self) -> Moment:
        """Returns this moment, for `can_stand_for`."""
        return Moment(self._operations, self._touches, len(self._writes))

    def can_stand_for(self, since: Moment, inputs: object, output: object) -> bool:
        """Returns whether giving `output` again does all that a call of a submodule did.

        It does if the call did not depend on z, which the cut layer gives; if it changed no tensor
        in place that is older than the call; and if its output consists of tensors that it created,
        no two of them in the same memory.

        If it may have depended on z, its output is noted to depend on z.

        Args:
            since: The moment when the call began; it has just ended.
            inputs: Its inputs (args, kwargs).
            output: Its output.
        """
        # An input that depends on z, or may hide a tensor that does, counts as read: a native
        # extension reads its arguments unnoticed.
        has_z_input = any(self._is_marked(tensor) for _, tensor in tensors_in(inputs))
        if self._marked and (has_z_input or not is_transparent(inputs)):
            self._touches += 1
        # The tensors of its output that it created.
        storages = [storage_of(tensor) for _, tensor in tensors_in(output)]
        created_inside = {
            storage for storage in storages if self._created.get(storage, 0) > since.operations
        }
        if self._touches > since.touches:  # it may have depended on z
            self._marked.update(created_inside)
            return False
        is_all_new = len(created_inside) == len(storages)  # one storage for each tensor
        writes_inside = self._writes[since.writes :]
        changes_old = any(creator <= since.operations for creator in writes_inside)
        return is_transparent(output) and is_all_new and not changes_old

    @contextmanager
    def seeing_escapes_of(self, module: nn.Module) -> Iterator[None]:
        """Inside this context, values that reach Python by `Tensor.numpy` and the like are noted.

        They are not noted in torch's fused layers (`_FUSED`), nor if the watch notes no escapes.

        Args:
            module: The submodule that runs inside the context.
        """
        seen_outside = self._sees_escapes
        is_fused = getattr(type(module), "forward", None) in _FUSED
        self._sees_escapes = self._notes_escapes and not is_fused
        # The function mode (`_EscapeMode`) notes them while it is active. It is entered, or left
        # for a while, where that differs from outside. Only the innermost mode can be left, which
        # is another one where the network uses its own.
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
        """Runs an operation of torch, and notes what it created, changed and read.

        Torch calls this for every operation while the mode is active.

        Returns:
            What the operation gives.
        """
        kwargs = kwargs or {}
        effects = _effects_of(func)
        self._operations += 1
        inputs = [tensor for _, tensor in tensors_in((*args, *kwargs.values()))]
        # Reading a tensor that without a cut would have been changed with its twin is an error.
        if self._stale and any(storage_of(tensor) in self._stale for tensor in inputs):
            self.torn = True
        # Saved tensors are cloned before the operation changes them.
        written: list[Tensor] = []
        for index, name in effects.written:
            argument = args[index] if index < len(args) else kwargs.get(name)
            written += [tensor for _, tensor in tensors_in(argument)]
        for tensor in written:
            self._before_write(tensor)
        reads_z = bool(self._marked) and any(map(self._is_marked, inputs))
        result = func(*args, **kwargs)
        # New memory among its results belongs to this operation.
        results = {storage_of(tensor) for _, tensor in tensors_in(result)}
        created = results - {storage_of(tensor) for tensor in inputs} - {NO_STORAGE}
        self._created.update(dict.fromkeys(created, self._operations))
        # An address seen before may have been freed and reused.
        self._marked -= created
        # What an operation makes of z, or writes, depends on z.
        if reads_z:
            self._touches += 1
            self._marked |= results | {storage_of(tensor) for tensor in written}
        # Values that the operation gives to Python.
        if effects.values_escape and self._notes_escapes:
            self.escaped = True
            if reads_z:
                self.data_dependent = True
        return result

    def _before_write(self, tensor: Tensor) -> None:
        """Notes that a tensor is about to change in place, and clones what is saved of it."""
        storage = storage_of(tensor)
        self._writes.append(self._created.get(storage, 0))  # 0: it is older than the pass
        # Without a cut, z and the tensor of the network that it stands for are one. So a change of
        # one of the two makes the other stale.
        twins = {storage_of(twin) for twin in self._twins}
        if storage in twins:
            self._stale |= twins - {storage}
        for saved in self._protected.pop(storage, []):
            saved.value = map_tensors(saved.value, lambda _, saved_tensor: saved_tensor.clone())
            saved.copied = True

    def _is_marked(self, tensor: Tensor) -> bool:
        """Whether a tensor depends on z."""
        # Only z requires gradient, so a tensor that does was computed from it.
        return tensor.requires_grad or storage_of(tensor) in self._marked


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
        """Runs a function of torch, after the watch has noted the values that it gives to Python.

        Torch calls this for every function of its own while the mode is active.
        """
        if func in _ESCAPES and isinstance(args[0], Tensor):
            self._watch.note_escape(args[0])
        return func(*args, **(kwargs or {}))


class _Effects(NamedTuple):
    """What an operation of torch does besides computing its result."""

    written: list[tuple[int, str]]
    """Number and name of each argument that it changes in place."""
    values_escape: bool
    """Whether it gives values of tensors, or shapes that depend on them, to Python."""


@functools.cache
def _effects_of(func: OpOverload) -> _Effects:
    """The effects that torch states of an operation, in its schema and its tags."""
    written = [
        (number, argument.name)
        for number, argument in enumerate(func._schema.arguments)
        if argument.alias_info and argument.alias_info.is_write
    ]
    tags = (torch.Tag.data_dependent_output, torch.Tag.dynamic_output_shape)
    return _Effects(written, any(tag in func.tags for tag in tags))
