"""Options that several commands share, each defined once."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import click

from pnpdepth_cli.commands.refinement.request import (
    FrameFiles,
    HoldOut,
    NetworkChoice,
    OutputOptions,
    RefineRequest,
)
from pnpdepth_cli.commands.sparse.options import ColmapOptions, ScanOptions
from pnpdepth_cli.errors import UsageError
from pnpdepth_cli.settings import LARGEST_SEED, OptionField, Settings, options_of

FILE = click.Path(path_type=Path)
SEED = click.IntRange(0, LARGEST_SEED)


def click_option(declared: OptionField) -> Callable[[Any], Any]:
    """Returns the click option of a field of a request."""
    option = declared.option
    details: dict[str, Any] = {"type": _type_of(declared)}
    if declared.type == "bool":
        details = {"is_flag": True}
    elif option.value_if_bare is not None:
        details |= {"is_flag": False, "flag_value": option.value_if_bare}
    return click.option(
        declared.flag,
        declared.name,
        default=declared.default,
        metavar=option.metavar,
        help=option.help,
        show_default=option.show_default,
        **details,
    )


_ASSIGNED = "_assigned"
"""Ending of the parameters of options that take several fields."""
_HELP_OF_GROUPS = {
    "--set": "Less common options, as in precision=bf16,sparse-size-ok.",
    "--scan": "How a LiDAR scan is read.",
    "--colmap": "Which points of a COLMAP model are used, and their unit.",
}


def _assigning(flag: str, members: Sequence[OptionField]) -> Callable[[Any], Any]:
    """The click option that takes values of these fields, as in `precision=bf16,sparse-size-ok`."""
    by_name = {member.name_within: member for member in members}
    forms = {name: _form(member) for name, member in by_name.items()}

    def parse(text: str) -> dict[str, Any]:
        chosen: dict[str, Any] = {}
        for part in text.split(","):
            name, equals, value = part.strip().partition("=")
            if name not in by_name:
                raise UsageError(f"{flag} {name}: choose from {', '.join(by_name)}")
            member = by_name[name]
            if (member.type == "bool") == bool(equals):
                raise UsageError(f"{flag} {part} must be {forms[name]}")
            chosen[member.name] = click.types.convert_type(_type_of(member))(value or "true")
        return chosen

    described = " · ".join(f"{forms[name]}: {by_name[name].option.help}" for name in by_name)
    return click.option(
        flag,
        flag.strip("-") + _ASSIGNED,
        type=parse,
        multiple=True,
        metavar="NAME=VALUE,…",
        help=f"{_HELP_OF_GROUPS[flag]}  {described}",
    )


def _form(member: OptionField) -> str:
    """How a field is given: NAME, or NAME=VALUE."""
    names = member.option.choices
    value = member.option.metavar or ("|".join(names) if names else member.type.upper())
    return member.name_within if member.type == "bool" else f"{member.name_within}={value}"


class _Names(click.Choice):  # type: ignore[type-arg]
    """One of the names, or the Python file of an entry of the user's own."""

    def __init__(self, names: Collection[str]) -> None:
        super().__init__(list(names))
        self._names = names

    def convert(self, value: Any, param: Any, ctx: Any) -> Any:
        if str(value).endswith(".py") and value in self._names:
            return value
        return super().convert(value, param, ctx)


def _type_of(declared: OptionField) -> Any:
    option = declared.option
    if option.choices is not None:
        return _Names(option.choices)
    if option.parse is not None:
        return option.parse
    if option.least is not None or option.most is not None:
        return click.IntRange(option.least, option.most)
    return {"int": int, "float": float, "str": str, "bool": bool, "Path": FILE}[declared.type]


def options_of_groups(
    *groups: type, without: Collection[str] = ()
) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Returns a decorator that adds the options of these groups of a request to a command.

    Args:
        *groups: Dataclasses of `pnpdepth_cli.commands.refinement.request`.
        without: Names of fields that are left out.
    """
    wanted = [each for group in groups for each in options_of(group) if each.name not in without]
    within: dict[str, list[OptionField]] = {}
    for each in wanted:
        if each.option.within is not None:
            within.setdefault(each.option.within, []).append(each)

    def decorate(command: Callable[..., Any]) -> Callable[..., Any]:
        for flag, members in within.items():
            command = _assigning(flag, members)(command)
        for each in reversed(wanted):
            if each.option.within is None:
                command = click_option(each)(command)
        return command

    return decorate


def refinement(command: Callable[..., Any]) -> Callable[..., Any]:
    """Adds the options of how a frame is refined, named as the fields of a `RefineRequest`."""
    groups = (FrameFiles, ColmapOptions, NetworkChoice, Settings, HoldOut, OutputOptions)
    return models(options_of_groups(*groups, without=["model"])(command))


def _only(group: type, name: str, flag: str | None = None) -> Callable[[Any], Any]:
    """The option of one field, on its own also where another option takes it with others."""
    each = next(each for each in options_of(group) if each.name == name)
    own = replace(each.option, within=None, flag=flag or each.option.flag)
    return click_option(replace(each, option=own))


_MODEL = next(each for each in options_of(NetworkChoice) if each.name == "model")
model = click_option(_MODEL)
models = click.option(
    "--model",
    "model",
    multiple=True,
    default=(_MODEL.default,),
    metavar=_MODEL.option.metavar,
    help=f"{_MODEL.option.help} Given several times, all are fused.  [default: {_MODEL.default}]",
)
checkpoint = _only(NetworkChoice, "checkpoint")
precision = _only(NetworkChoice, "precision")
device = _only(NetworkChoice, "device")
layer = _only(Settings, "layer")
output_kind = _only(NetworkChoice, "output_kind")
normalise = _only(NetworkChoice, "normalise")
depth_scale = _only(FrameFiles, "depth_scale")
channel = _only(FrameFiles, "channel")
seed = _only(Settings, "seed")
overwrite = _only(OutputOptions, "overwrite")
camera = _only(ScanOptions, "camera")
as_json = click.option("--json", "as_json", is_flag=True, help="Print the result as JSON.")
sample = click.option(
    "--sample",
    metavar="[PATTERN:]N|P%",
    help="Sample the sparse depth from the ground truth, as `pnpdepth sample` does.",
)
scan = options_of_groups(ScanOptions)
sparse_output = click.option(
    "-o",
    "--output",
    type=FILE,
    required=True,
    help="Sparse depth file: PNG, EXR, NPY, NPZ, PFM or TIFF map, or CSV rows x y depth.",
)


def table_files(*, csv: str, markdown: str, latex: str) -> Callable[[Any], Any]:
    """Returns a decorator that adds the options of `tables.TableFiles`.

    Args:
        csv: Help text of `--csv`.
        markdown: Help text of `--markdown`.
        latex: Help text of `--latex`.
    """

    def decorate(command: Any) -> Any:
        command = overwrite(as_json(command))
        for name, text in (("--latex", latex), ("--markdown", markdown), ("--csv", csv)):
            command = click.option(name, type=FILE, metavar="FILE|-", help=text)(command)
        return command

    return decorate


no_groups = click.option(
    "--no-groups", is_flag=True, help="Treat all frames as independent, also those of a sequence."
)


def taken(group: type, values: dict[str, Any]) -> dict[str, Any]:
    """Returns the options of this group by name; they are removed from `values`."""
    for name in [name for name in values if name.endswith(_ASSIGNED)]:
        for chosen in values.pop(name):
            values |= chosen
    names = [each.name for each in options_of(group)]
    return {name: values.pop(name) for name in names if name in values}


def request_of(values: dict[str, Any], **others: Any) -> RefineRequest:
    """Returns the request that these options of a command make.

    Args:
        values: Of the options of `scan` and `options_of_groups`, by their names.
        **others: Other fields of the request.
    """
    scan_options = ScanOptions(**taken(ScanOptions, values))
    others |= {"colmap": ColmapOptions(**taken(ColmapOptions, values))}
    if isinstance(values.get("model"), tuple):  # of the commands that take several
        first, *more = values["model"]
        others |= {"model": first, "more_models": tuple(more)}
        values = {name: value for name, value in values.items() if name != "model"}
    return RefineRequest.from_fields(scan=scan_options, **values, **others)


def height_and_width(text: str) -> tuple[int, int]:
    """Returns (H, W) from a text such as 480x640. Raises UsageError for any other text."""
    height, x, width = text.lower().partition("x")
    if not (x and height.isdecimal() and width.isdecimal() and int(height) and int(width)):
        raise UsageError(f"size {text!r} is not of the form HxW, such as 480x640")
    return int(height), int(width)
