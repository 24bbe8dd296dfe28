"""Options that several commands share, each defined once."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import MISSING
from pathlib import Path
from typing import Any

import click

from pnpdepth_cli.commands.batch.batch_request import BatchRequest
from pnpdepth_cli.commands.refinement.refine_request import (
    HoldOut,
    NetworkChoice,
    OutputOptions,
    RefineRequest,
)
from pnpdepth_cli.dataset.read_options import ReadOptions, ScanOptions
from pnpdepth_cli.settings import Option, Settings, options_of

FILE = click.Path(path_type=Path)
Command = Callable[..., None]
Decorator = Callable[[Command], Command]


def click_option(declared: Option) -> Decorator:
    """Returns the click option of a field of a request."""
    details: dict[str, Any] = {"type": _type_of(declared)}
    if declared.type == "bool":
        details = {"is_flag": True}
    elif declared.value_if_bare is not None:
        details |= {"is_flag": False, "flag_value": declared.value_if_bare}
    if declared.default is MISSING:
        details["required"] = True
    else:
        details["default"] = declared.default
    return click.option(
        declared.flag,
        declared.name,
        metavar=declared.metavar,
        help=declared.help,
        show_default=declared.show_default,
        **details,
    )


class _Names(click.Choice):  # type: ignore[type-arg]
    """One of the names, or the Python file of an entry of the user's own."""

    def __init__(self, names: Collection[str]) -> None:
        super().__init__(list(names))
        self._names = names

    def convert(self, value: str, param: click.Parameter | None, ctx: click.Context | None) -> str:
        is_file = value.endswith(".py") and value in self._names
        return value if is_file else super().convert(value, param, ctx)


def _type_of(declared: Option) -> Any:
    if declared.choices is not None:
        return _Names(declared.choices)
    if declared.parse is not None:
        return declared.parse
    if declared.least is not None or declared.most is not None:
        return click.IntRange(declared.least, declared.most)
    pairs = {"tuple[float, float]": (float, float), "tuple[int, int]": (int, int)}
    plain = {"int": int, "float": float, "str": str, "bool": bool, "Path": FILE}
    return (pairs | plain)[declared.type]


def options_of_groups(*groups: type, without: Collection[str] = ()) -> Decorator:
    """Returns a decorator that adds the options of these groups of a request to a command.

    Args:
        *groups: Dataclasses whose fields are made by `pnpdepth_cli.settings.option`.
        without: Names of fields that are left out.
    """

    def decorate(command: Command) -> Command:
        wanted = [each for group in groups for each in options_of(group)]
        for each in reversed(wanted):
            command = command if each.name in without else click_option(each)(command)
        return command

    return decorate


def refinement(*, without: Collection[str] = ()) -> Decorator:
    """Returns a decorator that adds the options of how a frame is refined.

    Args:
        without: Names of fields of a `RefineRequest` that are left out.
    """
    groups = (ScanOptions, ReadOptions, NetworkChoice, Settings, HoldOut, OutputOptions)

    def decorate(command: Command) -> Command:
        return models(options_of_groups(*groups, without=["model", *without])(command))

    return decorate


def _declared(group: type, name: str) -> Option:
    return next(each for each in options_of(group) if each.name == name)


_MODEL = _declared(NetworkChoice, "model")
model = click_option(_MODEL)
models = click.option(
    "--model",
    "model",
    multiple=True,
    default=(_MODEL.default,),
    metavar=_MODEL.metavar,
    help=f"{_MODEL.help} Given several times, all are fused.  [default: {_MODEL.default}]",
)
checkpoint = click_option(_declared(NetworkChoice, "checkpoint"))
depth_scale = click_option(_declared(ReadOptions, "depth_scale"))
pose_kind = click_option(_declared(BatchRequest, "pose_kind"))
seed = click_option(_declared(Settings, "seed"))
overwrite = click_option(_declared(OutputOptions, "overwrite"))
as_json = click.option("--json", "as_json", is_flag=True, help="Print the result as JSON.")
sparse_output = click.option(
    "-o",
    "--output",
    type=FILE,
    required=True,
    help="Sparse depth file: PNG, EXR, NPY, NPZ, PFM or TIFF map, or CSV rows x y depth.",
)


def take_options(group: type, values: dict[str, Any]) -> dict[str, Any]:
    """Returns the options of this group by name; they are removed from `values`."""
    names = [each.name for each in options_of(group)]
    return {name: values.pop(name) for name in names if name in values}


def request_of(values: dict[str, Any], **others: Any) -> RefineRequest:
    """Returns the request that these options of a command make.

    Args:
        values: Values of the options of `refinement`, by their names; some are removed.
        **others: Other fields of the request.
    """
    scan = ScanOptions(**take_options(ScanOptions, values))
    first, *more = values.pop("model")
    models = {"model": first, "more_models": tuple(more)}
    return RefineRequest().with_fields(scan=scan, **models, **values, **others)
