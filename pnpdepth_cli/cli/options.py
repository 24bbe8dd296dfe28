"""Options that several commands share, each defined once."""

from __future__ import annotations

from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any

import click

from pnpdepth_cli.budget import set_max_pixels
from pnpdepth_cli.errors import UsageError
from pnpdepth_cli.pipeline.options import OptionField, options_of, parse_file
from pnpdepth_cli.pipeline.refinement.request import (
    LARGEST_SEED,
    FrameFiles,
    HoldOut,
    MethodOptions,
    NetworkChoice,
    OutputOptions,
    RefineRequest,
)
from pnpdepth_cli.pipeline.sparse.options import ColmapOptions, ScanOptions

FILE = click.Path(path_type=Path)
SEED = click.IntRange(0, LARGEST_SEED)


class Address(click.Path):
    """A local path, or the address of a file or folder in a store."""

    def convert(self, value: Any, param: Any, ctx: Any) -> Any:
        """Returns the path."""
        text = super().convert(value, param, ctx)
        return parse_file(text) if isinstance(text, str) else text


class Renamed(click.Option):
    """An option whose former spelling is still accepted and not shown in the help."""

    def __init__(self, *args: Any, alias: str, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.alias = alias

    def add_to_parser(self, parser: Any, ctx: click.Context) -> None:
        """Adds both spellings."""
        super().add_to_parser(parser, ctx)
        parser.add_option(obj=self, opts=[self.alias], dest=self.name, action="store")


def click_option(each: OptionField) -> Callable[[Any], Any]:
    """Returns the click option of a field of a request."""
    option = each.option
    details: dict[str, Any] = {}
    if each.type == "bool":
        details["is_flag"] = True
    else:
        details["type"] = _type_of(each)
    if option.value_if_bare is not None:
        details |= {"is_flag": False, "flag_value": option.value_if_bare}
    if option.show_default:
        details["show_default"] = True
    if option.hidden:
        details["hidden"] = True
    if option.alias is not None:
        details |= {"cls": Renamed, "alias": option.alias}
    return click.option(
        each.flag,
        each.name,
        default=each.default,
        metavar=option.metavar,
        help=option.help,
        **details,
    )


def _type_of(each: OptionField) -> Any:
    option = each.option
    if option.choices is not None:
        return click.Choice(list(option.choices))
    if option.parse is not None:
        return option.parse
    if option.least is not None or option.most is not None:
        return click.IntRange(option.least, option.most)
    return {"int": int, "float": float, "str": str, "Path": FILE}[each.type]


def options_of_groups(
    *groups: type, without: Collection[str] = ()
) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Returns a decorator that adds the options of these groups of a request to a command.

    Args:
        *groups: Dataclasses of `pnpdepth_cli.pipeline.refinement.request`.
        without: Names of fields that are left out.
    """

    def decorate(command: Callable[..., Any]) -> Callable[..., Any]:
        wanted = [each for group in groups for each in options_of(group)]
        for each in reversed(wanted):
            if each.name not in without:
                command = click_option(each)(command)
        return command

    return decorate


def refinement(command: Callable[..., Any]) -> Callable[..., Any]:
    """Adds the options of how a frame is refined, named as the fields of a `RefineRequest`."""
    groups = (FrameFiles, ColmapOptions, NetworkChoice, MethodOptions, HoldOut, OutputOptions)
    return models(options_of_groups(*groups, without=["model"])(command))


def _only(group: type, name: str) -> Callable[[Any], Any]:
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
precision = _only(NetworkChoice, "precision")
device = _only(NetworkChoice, "device")
layer = _only(MethodOptions, "layer")
target = _only(MethodOptions, "target")
depth_scale = _only(FrameFiles, "depth_scale")
channel = _only(FrameFiles, "channel")
seed = _only(HoldOut, "seed")
overwrite = _only(OutputOptions, "overwrite")
camera = _only(ScanOptions, "camera")
as_json = click.option("--json", "as_json", is_flag=True, help="Print the result as JSON.")


def _allow_pixels(
    context: click.Context, parameter: click.Parameter, max_pixels: int | None
) -> None:
    set_max_pixels(max_pixels)


max_pixels = click.option(
    "--max-pixels",
    type=click.IntRange(1),
    metavar="N",
    expose_value=False,
    callback=_allow_pixels,
    help="Largest image to read; files may have 4 N bytes.  [default: memory / 64, at most 2^28]",
)
sample = click.option(
    "--sample",
    metavar="[PATTERN:]N|P%",
    help="Sample the sparse depth from the ground truth, as `pnpdepth sample` does.",
)


def scan(command: Callable[..., Any]) -> Callable[..., Any]:
    """Adds the options of a LiDAR scan, and `--max-pixels`."""
    return options_of_groups(ScanOptions)(max_pixels(command))


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


bootstrap_seed = click.option(
    "--seed", type=SEED, default=0, show_default=True, metavar="N", help="Of --bootstrap."
)
no_groups = click.option(
    "--no-groups", is_flag=True, help="Treat all frames as independent, also those of a sequence."
)


def taken(group: type, values: dict[str, Any]) -> dict[str, Any]:
    """Returns the options of this group by name; they are removed from `values`."""
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
