"""Tensors in nested containers, saved for later passes, and the state of a network."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Callable, Iterator, MutableMapping
from dataclasses import dataclass

import torch
from torch import Tensor, nn


def tensors_in(
    structure: object, path: tuple[str, ...] = ()
) -> Iterator[tuple[tuple[str, ...], Tensor]]:
    """Yields every tensor of a nested structure with its path, such as ("hidden_states", "0")."""
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
    """Returns the structure with tensor t at path p replaced by change(p, t), in new containers."""
    if isinstance(structure, Tensor):
        return change(path, structure)
    parts = _children(structure)
    if parts is None:
        return structure
    children = [map_tensors(child, change, (*path, key)) for key, child in parts]
    if isinstance(structure, tuple):
        make: Callable[..., object] = type(structure)
        return make(*children) if hasattr(structure, "_fields") else make(children)
    result = copy.copy(structure)
    if isinstance(result, list):
        result[:] = children
    elif isinstance(result, MutableMapping):
        for key, child in zip(result, children, strict=True):
            result[key] = child
    else:
        for (name, _), child in zip(parts, children, strict=True):
            object.__setattr__(result, name, child)  # the dataclass may be frozen
    return result


def is_transparent(structure: object) -> bool:
    """Whether `tensors_in` is sure to find every tensor of the structure."""
    if structure is None or isinstance(structure, Tensor | int | float | str | bool):
        return True
    parts = _children(structure)
    return parts is not None and all(is_transparent(child) for _, child in parts)


def _children(structure: object) -> list[tuple[str, object]] | None:
    """The parts of a container by their keys. None: it is none."""
    if isinstance(structure, list | tuple):
        return [(str(index), child) for index, child in enumerate(structure)]
    if isinstance(structure, MutableMapping):
        return [(str(key), child) for key, child in structure.items()]
    if dataclasses.is_dataclass(structure) and not isinstance(structure, type):
        return [(f.name, getattr(structure, f.name)) for f in dataclasses.fields(structure)]
    return None


@dataclass(eq=False)
class SavedTensors:
    """Tensors in nested containers, as they were when saved."""

    value: object = None
    copied: bool = False
    """Whether the network changes them in place, so that `fresh` returns clones."""

    @classmethod
    def of(cls, output: object, *, copied: bool = False) -> SavedTensors:
        """Returns the tensors of an output in new containers, clones if they are `copied`."""
        return cls(map_tensors(output, lambda _, t: t.clone() if copied else t), copied)

    def fresh(self) -> object:
        """Returns the tensors in new containers; whatever is done to them leaves `value` as is."""
        return map_tensors(
            self.value, lambda _, t: t.clone() if self.copied or t.is_inference() else t
        )


class NetworkState:
    """Values, gradient flags and modes of a network at the time this object is created.

    Attributes:
        tensors: Parameters and buffers; a `Watch` that protects them saves those that change.
    """

    def __init__(self, network: nn.Module) -> None:
        modules = list(network.modules())
        parameters = list(network.parameters())
        # Frozen torch scripts have neither a mode nor buffers that can be set.
        plain = [m for m in modules if not isinstance(m, torch.jit.ScriptModule)]
        self._originals = [*parameters, *network.buffers()]
        self.tensors = [SavedTensors(tensor) for tensor in self._originals]
        self._learning = [(p, p.requires_grad) for p in parameters]
        self._buffers = [(m, dict(m._buffers)) for m in plain if m._buffers]
        self._modes = [(m, m.training) for m in modules if hasattr(m, "training")]

    def freeze(self) -> None:
        """Switches off the gradients of all parameters."""
        for parameter, _ in self._learning:
            parameter.requires_grad_(False)

    def restore(self) -> None:
        """Restores the values of parameters and buffers that the network has changed."""
        for module, buffers in self._buffers:
            module._buffers.update(buffers)
        with torch.no_grad():
            for original, saved in zip(self._originals, self.tensors, strict=True):
                if saved.copied and isinstance(saved.value, Tensor):
                    original.copy_(saved.value)

    def close(self) -> None:
        """Restores everything."""
        self.restore()
        for parameter, requires_grad in self._learning:
            parameter.requires_grad_(requires_grad)
        for module, training in self._modes:
            module.training = training
