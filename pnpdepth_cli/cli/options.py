"""Options that several commands share, each defined once, and help that shows them in groups."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping
from dataclasses import Field
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
        """Returns the path of the text; an empty text is an error of usage."""
        if value == "":
            self.fail("an empty text names no file", param, ctx)
        return super().convert(value, param, ctx)


FILE = _File(path_type=Path)
_NOT_SHOWN = (None, False, 0, math.inf)
"""Defaults that the help does not show: nothing, off, or no limit."""
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
    details = {"type": _type_of(declared), "default": declared.default, **declared.metadata}
    # Entries of the field's metadata that are no arguments of click.
    for name in ("flag", "choices", "least", "most"):
        details.pop(name, None)
    if declared.type == "bool":
        details["is_flag"] = True
    details.setdefault("show_default", declared.default not in _NOT_SHOWN)
    return click.option(flag_of(declared), declared.name, **details)


class _Names(click.Choice):  # type: ignore[type-arg]
    """One of the names, or the Python file of an entry of the user's own."""

    def __init__(self, names: Collection[str]) -> None:
        super().__init__(list(names))
        self._names = names

    def convert(self, value: str, param: click.Parameter | None, ctx: click.Context | None) -> str:
        """Returns the text if it is a name of the list, or a Python file that the list takes."""
        is_file = value.endswith(".py") and value in self._names
        return value if is_file else super().convert(value, param, ctx)


def _type_of(declared: Field[Any]) -> Any:
    """The type by which click reads the option's text, and refuses what is no value of it.

    That is a name of a list, a whole number within limits, or the type of the dataclass's field.

    None leaves the type to click; the option then states its own, or is a text.
    """
    if "choices" in declared.metadata:
        return _Names(declared.metadata["choices"])
    least = declared.metadata.get("least")
    most = declared.metadata.get("most")
    if least is not None or most is not None:
        return click.IntRange(least, most)
    types = {
        "int": int,
        "float": float,
        "str": str,
        "bool": bool,
        "Path": FILE,
        "tuple[float, float]": (float, float),
        "tuple[int, int]": (int, int),
    }
    # Of several types, as in `float | str | None`, the last but None: a text can hold each of them.
    name = str(declared.type).removesuffix(" | None").rpartition(" | ")[2]
    return types.get(name)


def options_of_groups(*groups: type, without: Collection[str] = ()) -> Decorator:
    """Returns a decorator of a command that adds the options of dataclasses.

    Args:
        groups: Dataclasses with fields that `pnpdepth_cli.settings.option` made.
        without: Names of fields whose options are left out.
    """

    def decorate(command: Command) -> Command:
        """Returns the command with the options."""
        declared = [field for group in groups for field in options_of(group)]
        for field in reversed(declared):  # the option of a decorator above comes first in the help
            if field.name not in without:
                command = click_option(field)(command)
        return command

    return decorate


def refinement(*, without: Collection[str] = ()) -> Decorator:
    """Returns a decorator of a command that adds all options of a refinement.

    Args:
        without: Names of fields, of `RefineRequest` and its groups, whose options are left out.
    """
    groups = (ScanOptions, ReadOptions, Settings, RefineRequest)

    def decorate(command: Command) -> Command:
        """Returns the command with all options of a refinement."""
        # --model may be given several times here, for which it has an option of its own.
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
    """Returns the values of a group's options by their field; they are removed from `values`.

    Args:
        group: Dataclass with fields that `pnpdepth_cli.settings.option` made.
        values: Values of a command's parameters by their name.
    """
    names = [field.name for field in options_of(group)]
    return {name: values.pop(name) for name in names if name in values}


def request_of(values: dict[str, Any]) -> RefineRequest:
    """Returns the request of a command with the options of `refinement`.

    Args:
        values: Values of the command's parameters by their name, all of them fields of the request
            or its groups; those of scans and networks are removed.
    """
    scan = ScanOptions(**take_options(ScanOptions, values))
    first, *more = values.pop("model")
    models = {"model": first, "more_models": tuple(more)}
    return RefineRequest().with_fields(scan=scan, **models, **values)


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
            """The long names of the options that a member of a group stands for."""
            if isinstance(member, str):
                return [member]
            return [flag for flag in map(flag_of, options_of(member)) if flag not in named]

        self.groups = {
            title: [flag for member in members for flag in flags(member)]
            for title, members in groups.items()
        }
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
        """Writes a section for each group, with the options that are shown."""
        parameters = self.get_params(ctx)
        options = {
            parameter.opts[-1]: parameter  # by the long name
            for parameter in parameters
            if isinstance(parameter, click.Option)
        }
        is_all_shown = bool(ctx.meta.get(_SHOW_ALL))
        for title, flags in {**self.groups, "Help": _HELP}.items():
            records = [
                options[flag].get_help_record(ctx)
                for flag in flags
                if flag in options and (is_all_shown or flag in self.common)
            ]
            rows = [record for record in records if record is not None]  # None: a hidden option
            if rows:
                with formatter.section(title):
                    formatter.write_dl(rows, col_max=_NAME_COLUMN)


def _show_all(context: click.Context, parameter: click.Parameter, value: bool) -> None:
    """Prints the help with all options and ends the command; click's callback of --help-all."""
    if value and not context.resilient_parsing:  # click parses so for completion, which is silent
        context.meta[_SHOW_ALL] = True
        click.echo(context.get_help(), color=context.color)
        context.exit()
