"""`batch --vary`: every combination of values of options of a command."""

from __future__ import annotations

import itertools
import re
from collections.abc import Sequence
from typing import Any, NamedTuple

import click
from click.core import ParameterSource

from pnpdepth_cli.cli.grouped_help import GroupedCommand, long_name
from pnpdepth_cli.errors import UsageError

DEFAULT = "default"
"""A value that leaves the option out."""
_GROUPS = ("Network", "Method", "Sequences")
"""Groups of the help whose options can be varied, besides --sample."""
_NOT_IN_NAMES = re.compile(r'[<>:"/\\|?*]')
"""Characters that a folder's name cannot have, on some system."""


class Combination(NamedTuple):
    """One value of each varied option."""

    texts: dict[str, str]
    """The values as the user wrote them, by the option's name without dashes."""
    values: dict[str, Any]
    """The values by the name of the command's parameter; without those left out."""

    @property
    def folder(self) -> str:
        """The name of the folder of its results, such as `lr=1%,iterations=5`."""
        return ",".join(f"{n}={_NOT_IN_NAMES.sub('-', text)}" for n, text in self.texts.items())


def combinations_of(context: click.Context, varied: Sequence[str]) -> list[Combination]:
    """Returns the combinations of the values of all `--vary`; the last one's change fastest.

    Args:
        context: The parsed options of the command.
        varied: Texts such as `lr=1%,3%`.

    Raises:
        UsageError: An option cannot be varied, is given besides, or two folders have one name.
        click.UsageError: A value is none of the option's.
    """
    options = [_option(context, text.partition("=")[0]) for text in varied]
    axes = [text.partition("=")[2].split(",") for text in varied]
    if any("" in axis for axis in axes):
        raise UsageError("--vary must be NAME=VALUE,VALUE with no value empty")
    combinations = []
    for words in itertools.product(*axes):
        texts, values = dict[str, str](), dict[str, Any]()
        for option, word in zip(options, words, strict=True):
            texts[long_name(option).removeprefix("--")] = word
            if word != DEFAULT:
                taken = (word,) if option.multiple else word
                values[str(option.name)] = option.type_cast_value(context, taken)
        combinations.append(Combination(texts, values))
    folders = {combination.folder for combination in combinations}
    if len(folders) < len(combinations) or len({*options}) < len(options):
        raise UsageError("--vary: an option or a value comes twice; leave one out")
    return combinations


def _option(context: click.Context, name: str) -> click.Option:
    """The option that can be varied by this name."""
    command = context.command
    assert isinstance(command, GroupedCommand)
    flags = ["--sample", *(flag for group in _GROUPS for flag in command.groups[group])]
    if f"--{name}" not in flags:
        known = ", ".join(flag.removeprefix("--") for flag in flags)
        raise UsageError(f"--vary {name}: choose from {known}")
    options = (each for each in command.params if isinstance(each, click.Option))
    option = next(each for each in options if long_name(each) == f"--{name}")
    if context.get_parameter_source(str(option.name)) is ParameterSource.COMMANDLINE:
        raise UsageError(f"--{name} is varied; leave it out besides")
    return option
