"""Checks the fields of a definition; each function raises ModelError if its field is wrong.

Nothing here imports torch, as the definitions themselves do not.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable
from numbers import Integral, Real
from typing import NoReturn

from pnpdepth_cli.errors import ModelError

_MAX_SHOWN = 60  # characters of a wrong value that are shown
_SYNONYMS = {
    ("output_kind", "disparity"): "; disparity is 'inverse'",
    ("output_scale", "relative"): (
        "; relative depth is 'scale' (up to a factor) or 'affine' (a shift as well)"
    ),
}
"""Hints for words that others use, by field and word."""


def one_of(owner: object, field: str, valid: Collection[str]) -> None:
    """Checks that the field is one of these names."""
    value = getattr(owner, field)
    if not isinstance(value, str) or value not in valid:
        hint = _SYNONYMS.get((field, str(value)), "")
        refuse(owner, field, f"is none of {', '.join(map(repr, valid))}{hint}")


def whole(owner: object, field: str) -> None:
    """Checks that the field is a whole number of at least 1."""
    value = getattr(owner, field)
    if not isinstance(value, Integral) or isinstance(value, bool) or int(value) < 1:
        refuse(owner, field, "is not a whole number of at least 1")


def per_channel(owner: object, field: str, *, positive: bool = False) -> None:
    """Checks that the field holds three finite numbers, for red, green and blue."""
    value = getattr(owner, field)
    numbers = list(value) if isinstance(value, Iterable) else []
    good = len(numbers) == 3 and all(map(_is_number, numbers))
    if not good or (positive and min(numbers) <= 0):
        above = " above 0" if positive else ""
        refuse(owner, field, f"is not three numbers{above}, for red, green and blue")


def names(owner: object, field: str) -> None:
    """Checks that the field is a tuple or a list of texts."""
    value = getattr(owner, field)
    if not isinstance(value, tuple | list) or not all(isinstance(name, str) for name in value):
        refuse(owner, field, "is not a tuple of texts, as in ('encoder', 'decoder.up1')")


def instance(owner: object, field: str, kinds: type | tuple[type, ...], wanted: str) -> None:
    """Checks that the field is of one of these types; `wanted` names them in the message."""
    value = getattr(owner, field)
    if not isinstance(value, kinds):
        refuse(owner, field, f"is a {type(value).__name__}, where {wanted} is expected")


def function(owner: object, field: str) -> None:
    """Checks that the field can be called."""
    if not callable(getattr(owner, field)):
        refuse(owner, field, "cannot be called; give a function or a class")


def refuse(owner: object, field: str, why: str) -> NoReturn:
    """Raises ModelError with type and name of the owner, the field, its value, and the reason."""
    name = getattr(owner, "name", None)
    owner_name = (
        f"{type(owner).__name__} {name!r}" if isinstance(name, str) else type(owner).__name__
    )
    shown = " ".join(repr(getattr(owner, field)).split())
    shown = shown if len(shown) <= _MAX_SHOWN else shown[: _MAX_SHOWN - 1] + "…"
    raise ModelError(f"{owner_name}: {field}={shown} {why}")


def _is_number(value: object) -> bool:
    return isinstance(value, Real) and not isinstance(value, bool) and math.isfinite(value)
