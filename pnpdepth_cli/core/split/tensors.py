"""Tensors in nested containers, saved for later passes, and the state of a network."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Callable, Iterator, MutableMapping
from dataclasses import dataclass

import torch
from torch import Tensor, nn

NO_STORAGE = 0
"""The number that stands for the memory of sparse tensors, which have no storage."""


def storage_of(tensor: Tensor) -> int:
    """Returns a number that tensors in the same memory share; `NO_STORAGE` for a sparse tensor.

    It is the address of torch's storage object; a sparse tensor raises NotImplementedError.
    """
    try:
        return int(tensor.untyped_storage()._cdata)
    except NotImplementedError:
        return NO_STORAGE


def tensors_in(
    structure: object, path: tuple[str, ...] = ()
) -> Iterator[tuple[tuple[str, ...], Tensor]]:
    """Yields every tensor of a nested structure with its path, such as ("hidden_states", "0").

    Args:
        structure: A tensor, or lists, tuples, dicts and dataclasses with tensors; other objects
            have none.
        path: Path of the structure itself, in front of all paths.
    """
    if isinstance(structure, Tensor):
        yield path, structure
        return
    for key, child in _children(structure) or ():
        yield from tensors_in(child, (*path, key))


def map_tensors(
    structure: object,
    change: Callable[[tuple[str, ...], Tensor], Tensor],
    path: tuple[str, ...] = (),
) -> object:
    """Returns a copy of a nested structure with other tensors; the structure stays as it is.

    Args:
        structure: A tensor, or nested containers as of `tensors_in`; another object is returned
            itself.
        change: Function that takes the path of a tensor and the tensor to what replaces it.
        path: Path of the structure itself, in front of all paths.
    """
    if isinstance(structure, Tensor):
        return change(path, structure)
    children = _children(structure)
    if children is None:
        return structure
    changed = [map_tensors(child, change, (*path, key)) for key, child in children]
    # A container of the same type. A NamedTuple is made of arguments, another tuple of a list.
    if isinstance(structure, tuple):
        make: Callable[..., object] = type(structure)
        return make(*changed) if hasattr(structure, "_fields") else make(changed)
    container = copy.copy(structure)
    if isinstance(container, list):
        container[:] = changed
    elif isinstance(container, MutableMapping):
        for key, child in zip(container, changed, strict=True):
            container[key] = child
    else:
        for (name, _), child in zip(children, changed, strict=True):
            object.__setattr__(container, name, child)  # the dataclass may be frozen
    return container


def is_transparent(structure: object) -> bool:
    """Whether `tensors_in` is sure to find every tensor of the structure.

    It is not if there is an object that is neither a container nor a number or text.
    """
    if structure is None or isinstance(structure, Tensor | int | float | str | bool):
        return True
    children = _children(structure)
    return children is not None and all(is_transparent(child) for _, child in children)


def _children(structure: object) -> list[tuple[str, object]] | None:
    """What a container holds, each with its key, index or field name; None if it is no container.

    Containers are lists, tuples, mutable mappings and dataclasses.
    """
    if isinstance(structure, list | tuple):
        return [(str(index), child) for index, child in enumerate(structure)]
    if isinstance(structure, MutableMapping):
        return [(str(key), child) for key, child in structure.items()]
    if dataclasses.is_dataclass(structure) and not isinstance(structure, type):
        names = [field.name for field in dataclasses.fields(structure)]
        return [(name, getattr(structure, name)) for name in names]
    return None


@dataclass(eq=False)
class SavedTensors:
    """Tensors in nested containers, as they were when saved."""

    value: object = None
    """Nested containers with the tensors; None before there are any."""
    copied: bool = False
    """Whether the network changes them in place, so that `fresh` returns clones."""

    @classmethod
    def of(cls, output: object, *, copied: bool = False) -> SavedTensors:
        """Returns the tensors of an output in new containers, clones if they are `copied`."""

        def clone_if_copied(path: tuple[str, ...], tensor: Tensor) -> Tensor:
            """The tensor to save, wherever its path leads to."""
            return tensor.clone() if copied else tensor

        return cls(map_tensors(output, clone_if_copied), copied)

    def fresh(self) -> object:
        """Returns the tensors in new containers, for the network to use; `value` stays as it is."""

        def clone_if_needed(path: tuple[str, ...], tensor: Tensor) -> Tensor:
            """The tensor for the network to use, wherever its path leads to."""
            # One of inference mode cannot be saved for a backward pass.
            return tensor.clone() if self.copied or tensor.is_inference() else tensor

        return map_tensors(self.value, clone_if_needed)


class NetworkState:
    """Values, gradient flags and modes of a network at the time this object is created.

    Attributes:
        tensors: Parameters and buffers; a `Watch` that protects them saves those that change.
    """

    def __init__(self, network: nn.Module) -> None:
        modules = list(network.modules())
        parameters = list(network.parameters())
        # The values, which are copied only where a `Watch` sees that they are about to change.
        self._originals = [*parameters, *network.buffers()]
        self.tensors = [SavedTensors(tensor) for tensor in self._originals]
        self._gradient_flags = [(parameter, parameter.requires_grad) for parameter in parameters]
        # Frozen torch scripts have neither a mode nor buffers that can be set.
        self._buffers = [
            (module, dict(module._buffers))
            for module in modules
            if not isinstance(module, torch.jit.ScriptModule) and module._buffers
        ]
        self._modes = [
            (module, module.training) for module in modules if hasattr(module, "training")
        ]

    def freeze(self) -> None:
        """Switches off the gradients of all parameters."""
        for parameter, _ in self._gradient_flags:
            parameter.requires_grad_(False)

    def restore(self) -> None:
        """Restores the values of parameters and buffers that the network has changed.

        A buffer may have been replaced by another tensor, or changed in place like a parameter.
        """
        for module, buffers in self._buffers:
            module._buffers.update(buffers)
        with torch.no_grad():
            for original, saved in zip(self._originals, self.tensors, strict=True):
                if saved.copied and isinstance(saved.value, Tensor):
                    original.copy_(saved.value)

    def close(self) -> None:
        """Restores values, gradient flags and modes."""
        self.restore()
        for parameter, requires_grad in self._gradient_flags:
            parameter.requires_grad_(requires_grad)
        for module, training in self._modes:
            module.training = training
