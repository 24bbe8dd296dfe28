"""Tensors in nested containers: tuples, lists, dicts, named tuples, dataclasses."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Callable, Iterator, MutableMapping
from typing import Any

from torch import Tensor


def tensors_in(
    structure: Any, path: tuple[str, ...] = ()
) -> Iterator[tuple[tuple[str, ...], Tensor]]:
    """Yields every tensor of a nested structure with its path, such as ("hidden_states", "0")."""
    if isinstance(structure, Tensor):
        yield path, structure
        return
    for key, child in _children(structure):
        yield from tensors_in(child, (*path, key))


def map_tensors(
    structure: Any, change: Callable[[tuple[str, ...], Tensor], Tensor], path: tuple[str, ...] = ()
) -> Any:
    """Returns the structure with tensor t at path p replaced by change(p, t), in new containers."""
    if isinstance(structure, Tensor):
        return change(path, structure)
    children = [map_tensors(child, change, (*path, key)) for key, child in _children(structure)]
    if isinstance(structure, tuple):
        named = hasattr(structure, "_fields")
        return type(structure)(*children) if named else type(structure)(children)
    if not _is_container(structure):
        return structure
    result: Any = copy.copy(structure)
    if isinstance(structure, list):
        result[:] = children
    elif isinstance(structure, MutableMapping):
        for key, child in zip(structure, children, strict=True):
            result[key] = child
    else:
        for field, child in zip(dataclasses.fields(structure), children, strict=True):
            object.__setattr__(result, field.name, child)  # the dataclass may be frozen
    return result


def is_transparent(structure: Any) -> bool:
    """Whether `tensors_in` is sure to find every tensor of the structure."""
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
