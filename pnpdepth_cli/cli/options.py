"""Options that several commands share, each defined once, and help that shows them in groups."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping
from dataclasses import Field
from itertools import chain
from pathlib import Path
from typing import Any

import click

from pnpdepth_cli.commands.requests.batch_request import BatchRequest
from pnpdepth_cli.commands.requests.refine_request import RefineRequest
from pnpdepth_cli.dataset.frame_files import ReadOptions, ScanOptions
from pnpdepth_cli.settings import Settings, flag_of, options_of


class _File(click.Path):
    """A path; an empty text is none, where pathlib takes it for the current folder."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        if value == "":
            self.fail("an empty text names no file", param, ctx)
        return super().convert(value, param, ctx)


FILE = _File(path_type=Path)
_WITHOUT = (None, False, 0, math.inf)
"""Defaults that are no value to show."""
_NAME_COLUMN = 22
"""Characters of the column of names in the help."""
NETWORK = ("--model", "--checkpoint", "--normalise", "--device")
"""The options of the network, a group of the help."""
_HELP = ("--help", "--help-all")
_SHOW_ALL = "pnpdepth.help_all"
Command = Callable[..., None]
Decorator = Callable[[Command], Command]


def click_option(declared: Field[Any]) -> Decorator:
    """Returns the click option of a field that `pnpdepth_cli.settings.option` made."""
    default = declared.default
    details = {"type": _type_of(declared), "default": default, **declared.metadata}
    for ours in ("flag", "choices", "least", "most"):
        details.pop(ours, None)
    if declared.type == "bool":
        details["is_flag"] = True
    details.setdefault("show_default", default not in _WITHOUT)
    return click.option(flag_of(declared), declared.name, **details)


class _Names(click.Choice):  # type: ignore[type-arg]
    """One of the names, or the Python file of an entry of the user's own."""

    def __init__(self, names: Collection[str]) -> None:
        super().__init__(list(names))
        self._names = names

    def convert(self, value: str, param: click.Parameter | None, ctx: click.Context | None) -> str:
        is_file = value.endswith(".py") and value in self._names
        return value if is_file else super().convert(value, param, ctx)


def _type_of(declared: Field[Any]) -> Any:
    limits = declared.metadata.get("least"), declared.metadata.get("most")
    if "choices" in declared.metadata:
        return _Names(declared.metadata["choices"])
    if limits != (None, None):
        return click.IntRange(*limits)
    pairs = {"tuple[float, float]": (float, float), "tuple[int, int]": (int, int)}
    plain = {"int": int, "float": float, "str": str, "bool": bool, "Path": FILE}
    # Of several types the last, as in `float | str | None`.
    named = str(declared.type).removesuffix(" | None").rpartition(" | ")[2]
    return (pairs | plain).get(named)


def options_of_groups(*groups: type, without: Collection[str] = ()) -> Decorator:
    """Returns a decorator that adds the options of dataclasses, but those of some fields."""

    def decorate(command: Command) -> Command:
        declared = [field for group in groups for field in options_of(group)]
        for field in reversed(declared):  # the option of a decorator above comes first in the help
            if field.name not in without:
                command = click_option(field)(command)
        return command

    return decorate


def refinement(*, without: Collection[str] = ()) -> Decorator:
    """Returns a decorator that adds the options of a `RefineRequest`, but those of some fields."""
    groups = (ScanOptions, ReadOptions, Settings, RefineRequest)

    def decorate(command: Command) -> Command:
        return models(options_of_groups(*groups, without=["model", *without])(command))

    return decorate


_DECLARED = {
    field.name: field
    for group in (BatchRequest, RefineRequest, Settings, ReadOptions)
    for field in options_of(group)
}
_MODEL = _DECLARED["model"]
model = click_option(_MODEL)
models = click.option(
    "--model",
    "model",
    multiple=True,
    default=(_MODEL.default,),
    metavar=_MODEL.metadata["metavar"],
    help=f"{_MODEL.metadata['help']} Given several times, all are fused."
    f"  [default: {_MODEL.default}]",
)
checkpoint = click_option(_DECLARED["checkpoint"])
depth_scale = click_option(_DECLARED["depth_scale"])
pose_kind = click_option(_DECLARED["pose_kind"])
seed = click_option(_DECLARED["seed"])
overwrite = click_option(_DECLARED["overwrite"])
as_json = click.option("--json", "as_json", is_flag=True, help="Print the result as JSON.")
min_confidence = click.option(
    "--min-confidence",
    type=float,
    metavar="N",
    help="Least value of a confidence mask, such as 2 of 0…2, whose depth is used."
    "  [default: above 0]",
)
_sparse_output = click.option(
    "-o",
    "--output",
    type=FILE,
    required=True,
    help="Sparse depth file: PNG, EXR, NPY, NPZ, PFM or TIFF map, or CSV rows x y depth.",
)


def sparse_files(command: Command) -> Command:
    """Adds the options of a command that makes a file of sparse depth from other depth."""
    return depth_scale(_sparse_output(overwrite(command)))


def take_options(group: type, values: dict[str, Any]) -> dict[str, Any]:
    """Returns the options of this group by name; they are removed from `values`."""
    names = [field.name for field in options_of(group)]
    return {name: values.pop(name) for name in names if name in values}


def request_of(values: dict[str, Any], **others: Any) -> RefineRequest:
    """Returns the request of the options of `refinement`, some of which are removed, and others."""
    scan = ScanOptions(**take_options(ScanOptions, values))
    first, *more = values.pop("model")
    models = {"model": first, "more_models": tuple(more)}
    return RefineRequest().with_fields(scan=scan, **models, **values, **others)


class GroupedCommand(click.Command):
    """A command whose help lists its options in groups: `--help` the common ones, `--help-all` all.

    Plain click, because cloup and rich-click double the time of `pnpdepth --help`, and neither has
    a short and a long form of the help.

    Args:
        groups: Members of each group by its title, in the order of the help. A member is the long
            name of an option, or a dataclass of a request, which stands for those of its options
            that are named nowhere else. What the command does not have is skipped.
        common: Long names of the options that `--help` shows.
    """

    def __init__(
        self,
        *args: Any,
        groups: Mapping[str, tuple[str | type, ...]],
        common: tuple[str, ...],
        **kwargs: Any,
    ) -> None:
        super().__init__(*args, **kwargs)
        # A dataclass stands for its options that are named nowhere else.
        named = {member for members in groups.values() for member in members}

        def flags(member: str | type) -> list[str]:
            if isinstance(member, str):
                return [member]
            return [flag for flag in map(flag_of, options_of(member)) if flag not in named]

        self.groups = {title: [*chain(*map(flags, of))] for title, of in groups.items()}
        self.common = {*common, *_HELP}
        self.params.append(
            click.Option(
                ["--help-all"],
                is_flag=True,
                is_eager=True,
                expose_value=False,
                callback=_show_all,
                help="Show all options and exit.",
            )
        )

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Writes one section per group."""
        options = {o.opts[-1]: o for o in self.get_params(ctx) if isinstance(o, click.Option)}
        shown = options if ctx.meta.get(_SHOW_ALL) else self.common & {*options}
        for title, names in {**self.groups, "Help": _HELP}.items():
            records = [options[name].get_help_record(ctx) for name in names if name in shown]
            if rows := [record for record in records if record is not None]:
                with formatter.section(title):
                    formatter.write_dl(rows, col_max=_NAME_COLUMN)


def _show_all(context: click.Context, parameter: click.Parameter, value: bool) -> None:
    if value and not context.resilient_parsing:
        context.meta[_SHOW_ALL] = True
        click.echo(context.get_help(), color=context.color)
        context.exit()
