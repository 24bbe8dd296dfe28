"""Tensors inside what a module returns: tuples, lists, dicts, named tuples, dataclasses."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Callable, Iterator, Mapping
from typing import Any

from torch import Tensor


def tensors_in(
    structure: Any, path: tuple[str, ...] = ()
) -> Iterator[tuple[tuple[str, ...], Tensor]]:
    """Every tensor of a nested structure with its path, such as ("hidden_states", "0")."""
    if isinstance(structure, Tensor):
        yield path, structure
    for key, child in _children(structure):
        yield from tensors_in(child, (*path, key))


def map_tensors(
    structure: Any, change: Callable[[tuple[str, ...], Tensor], Tensor], path: tuple[str, ...] = ()
) -> Any:
    """The structure with every tensor t at path p replaced by change(p, t); containers are new."""
    if isinstance(structure, Tensor):
        return change(path, structure)
    children = {
        key: map_tensors(child, change, (*path, key)) for key, child in _children(structure)
    }
    if isinstance(structure, Mapping) and children:
        made: Any = copy.copy(structure)
        for key in structure:
            made[key] = children[str(key)]
        return made
    if isinstance(structure, tuple) and hasattr(structure, "_fields"):
        return type(structure)(*children.values())
    if isinstance(structure, list | tuple):
        return type(structure)(children.values())
    if children:
        return dataclasses.replace(structure, **children)
    return structure


def is_transparent(structure: Any) -> bool:
    """True if nothing in the structure could hide a tensor from `tensors_in`."""
    if structure is None or isinstance(structure, Tensor | int | float | str | bool):
        return True
    if isinstance(structure, Mapping | list | tuple) or _is_dataclass_value(structure):
        return all(is_transparent(child) for _, child in _children(structure))
    return False


def _children(structure: Any) -> Iterator[tuple[str, Any]]:
    if isinstance(structure, Mapping):
        yield from ((str(key), child) for key, child in structure.items())
    elif isinstance(structure, list | tuple):
        yield from ((str(index), child) for index, child in enumerate(structure))
    elif _is_dataclass_value(structure):
        for each in dataclasses.fields(structure):
            if each.init:
                yield each.name, getattr(structure, each.name)


def _is_dataclass_value(structure: Any) -> bool:
    return dataclasses.is_dataclass(structure) and not isinstance(structure, type)
