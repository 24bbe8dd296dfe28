"""Functions of point coordinates that remember their last results.

Many candidates are compared on the same points, and each asks for their neighbours and triangles.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np

R = TypeVar("R")

MOST_REMEMBERED = 1 << 16
"""Coordinate pairs up to which a result is remembered: what bounds the memory."""


def remembered(maxsize: int) -> Callable[[Callable[..., R]], Callable[..., R]]:
    """Returns a decorator that remembers a function's last `maxsize` results, by its arguments.

    Arguments are float64 arrays (N, 2), which the function gets read-only, and whole numbers.
    Results are shared between calls and must not be changed.
    """

    def decorated(function: Callable[..., R]) -> Callable[..., R]:
        @functools.lru_cache(maxsize)
        def known(*key: bytes | int) -> R:
            return function(*map(_array, key))

        @functools.wraps(function)
        def call(*args: Any) -> R:
            arrays = [arg for arg in args if isinstance(arg, np.ndarray)]
            if sum(map(len, arrays)) > MOST_REMEMBERED:
                return function(*args)
            return known(*(arg if isinstance(arg, int) else arg.tobytes() for arg in args))

        return call

    return decorated


def _array(key: bytes | int) -> Any:
    return key if isinstance(key, int) else np.frombuffer(key).reshape(-1, 2)
