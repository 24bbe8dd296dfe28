"""Options that several commands share, each defined once."""

from __future__ import annotations

from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any

import click

from pnpdepth_cli.commands.refinement.refine_request import (
    HoldOut,
    NetworkChoice,
    OutputOptions,
    RefineRequest,
)
from pnpdepth_cli.dataset.read_options import ReadOptions, ScanOptions
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
    if declared.type == "tuple[float, float]":
        return (float, float)
    return {"int": int, "float": float, "str": str, "bool": bool, "Path": FILE}[declared.type]


def options_of_groups(
    *groups: type, without: Collection[str] = ()
) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Returns a decorator that adds the options of these groups of a request to a command.

    Args:
        *groups: Dataclasses of `pnpdepth_cli.commands.refinement.refine_request`.
        without: Names of fields that are left out.
    """
    wanted = [each for group in groups for each in options_of(group) if each.name not in without]

    def decorate(command: Callable[..., Any]) -> Callable[..., Any]:
        for each in reversed(wanted):
            command = click_option(each)(command)
        return command

    return decorate


def refinement(*, without: Collection[str] = ()) -> Callable[[Any], Any]:
    """Returns a decorator that adds the options of how a frame is refined.

    Args:
        without: Names of fields of a `RefineRequest` that are left out.
    """
    groups = (ScanOptions, ReadOptions, NetworkChoice, Settings, HoldOut, OutputOptions)

    def decorate(command: Callable[..., Any]) -> Callable[..., Any]:
        return models(options_of_groups(*groups, without=["model", *without])(command))

    return decorate


def _only(group: type, name: str) -> Callable[[Any], Any]:
    """The option of one field."""
    return click_option(next(each for each in options_of(group) if each.name == name))


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
device = _only(NetworkChoice, "device")
layer = _only(Settings, "layer")
depth_scale = _only(ReadOptions, "depth_scale")
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


def table_files(*, csv: str, latex: str) -> Callable[[Any], Any]:
    """Returns a decorator that adds the options of `tables.TableFiles`.

    Args:
        csv: Help text of `--csv`.
        latex: Help text of `--latex`.
    """

    def decorate(command: Any) -> Any:
        command = overwrite(as_json(command))
        for name, text in (("--latex", latex), ("--csv", csv)):
            command = click.option(name, type=FILE, metavar="FILE|-", help=text)(command)
        return command

    return decorate


def take_options(group: type, values: dict[str, Any]) -> dict[str, Any]:
    """Returns the options of this group by name; they are removed from `values`."""
    names = [each.name for each in options_of(group)]
    return {name: values.pop(name) for name in names if name in values}


def request_of(values: dict[str, Any], **others: Any) -> RefineRequest:
    """Returns the request that these options of a command make.

    Args:
        values: Values of the options of `refinement`, by their names.
        **others: Other fields of the request.
    """
    scan_options = ScanOptions(**take_options(ScanOptions, values))
    if isinstance(values.get("model"), tuple):  # of the commands that take several
        first, *more = values["model"]
        others |= {"model": first, "more_models": tuple(more)}
        values = {name: value for name, value in values.items() if name != "model"}
    return RefineRequest.from_fields(scan=scan_options, **values, **others)
