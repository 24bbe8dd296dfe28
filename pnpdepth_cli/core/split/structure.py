"""Tensors inside what a module returns: tuples, lists, dicts, named tuples, dataclasses."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Callable, Iterator, MutableMapping
from typing import Any

from torch import Tensor


def tensors_in(
    structure: Any, path: tuple[str, ...] = ()
) -> Iterator[tuple[tuple[str, ...], Tensor]]:
    """Every tensor of a nested structure with its path, such as ("hidden_states", "0")."""
    if isinstance(structure, Tensor):
        yield path, structure
        return
    for key, child in _children(structure):
        yield from tensors_in(child, (*path, key))


def map_tensors(
    structure: Any, change: Callable[[tuple[str, ...], Tensor], Tensor], path: tuple[str, ...] = ()
) -> Any:
    """The structure with every tensor t at path p replaced by change(p, t); containers are new."""
    if isinstance(structure, Tensor):
        return change(path, structure)
    children = [map_tensors(child, change, (*path, key)) for key, child in _children(structure)]
    if isinstance(structure, tuple):
        named = hasattr(structure, "_fields")
        return type(structure)(*children) if named else type(structure)(children)
    if not _is_container(structure):
        return structure
    made: Any = copy.copy(structure)
    if isinstance(structure, list):
        made[:] = children
    elif isinstance(structure, MutableMapping):
        for key, child in zip(structure, children, strict=True):
            made[key] = child
    else:
        for field, child in zip(dataclasses.fields(structure), children, strict=True):
            object.__setattr__(made, field.name, child)  # the dataclass may be frozen
    return made


def is_transparent(structure: Any) -> bool:
    """True if nothing in the structure could hide a tensor from `tensors_in`."""
    if structure is None or isinstance(structure, Tensor | int | float | str | bool):
        return True
    return _is_container(structure) and all(
        is_transparent(child) for _, child in _children(structure)
    )


def _children(structure: Any) -> Iterator[tuple[str, Any]]:
    if isinstance(structure, list | tuple):
        yield from ((str(index), child) for index, child in enumerate(structure))
    elif isinstance(structure, MutableMapping):
        yield from ((str(key), child) for key, child in structure.items())
    elif _is_container(structure):
        yield from ((f.name, getattr(structure, f.name)) for f in dataclasses.fields(structure))


def _is_container(structure: Any) -> bool:
    return isinstance(structure, MutableMapping | list | tuple) or (
        dataclasses.is_dataclass(structure) and not isinstance(structure, type)
    )
