"""Fields of a request that the user can set: declared once, derived everywhere else.

A field made by `option` carries its help text, choices and spelling. The command line, the axes of
a sweep and the cache keys of a batch read them from there. Imports nothing heavy.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

from pnpdepth_cli.io.remote.address import path_of

_KEY = "option"


@dataclass(frozen=True, kw_only=True)
class Axis:
    """How a sweep shows a field that it can vary."""

    title: str
    """Label of the axis."""
    title_percent: str = ""
    """Label of the axis where the values are given in per cent."""
    log: bool = False
    """Whether equal ratios are drawn equally far apart."""


@dataclass(frozen=True, kw_only=True)
class Option:
    """What the command line says of a field."""

    help: str
    """Help text, one sentence."""
    flag: str | None = None
    """Spelling on the command line. None: the field's name with dashes."""
    alias: str | None = None
    """Former spelling, still accepted, not shown."""
    choices: Collection[str] | None = None
    """Names to choose from. None: any value of the field's type."""
    metavar: str | None = None
    """Placeholder of the value in the help."""
    least: int | None = None
    """Smallest value of an integer."""
    most: int | None = None
    """Largest value of an integer."""
    parse: Callable[[str], Any] | None = None
    """Converts the text of the command line. None: by the field's type."""
    value_if_bare: str | None = None
    """Value of the option where none follows. None: one has to."""
    show_default: bool = False
    """Whether the help shows the default."""
    hidden: bool = False
    """Whether the help does not show the option."""
    axis: Axis | None = None
    """How a sweep shows the field. None: a sweep does not vary it."""


@dataclass(frozen=True, kw_only=True)
class OptionField:
    """A field of a request with its option."""

    name: str
    """Name of the field."""
    type: str
    """Type of the value without "| None", as it is written."""
    default: Any
    """Default value."""
    option: Option
    """What the command line says of it."""

    @property
    def flag(self) -> str:
        """Spelling on the command line."""
        return self.option.flag or "--" + self.name.replace("_", "-")


def parse_file(text: str) -> Path:
    """Returns the path of a local file, or of one in a store. Raises UsageError as `path_of`."""
    return path_of(text)


def option(default: Any, help: str, **details: Any) -> Any:
    """Returns a dataclass field that the user can set.

    Args:
        default: Default of the field.
        help: Help text of the command line.
        **details: Other fields of `Option`.
    """
    return field(default=default, metadata={_KEY: Option(help=help, **details)})


def options_of(group: type) -> Iterator[OptionField]:
    """Yields the fields of a dataclass that were made by `option`, in their order."""
    for declared in fields(group):
        if _KEY in declared.metadata:
            yield OptionField(
                name=declared.name,
                type=str(declared.type).removesuffix(" | None"),
                default=declared.default,
                option=declared.metadata[_KEY],
            )
