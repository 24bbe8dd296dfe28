"""Options that several commands share, each defined once."""

from __future__ import annotations

from collections.abc import Callable, Collection
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from pnpdepth_cli.budget import set_max_pixels
from pnpdepth_cli.errors import UsageError
from pnpdepth_cli.pipeline.options import OptionField, options_of
from pnpdepth_cli.pipeline.refinement import request
from pnpdepth_cli.pipeline.refinement.request import (
    LARGEST_SEED,
    FrameFiles,
    HoldOut,
    MethodOptions,
    NetworkChoice,
    OutputOptions,
    RefineRequest,
)

if TYPE_CHECKING:
    from pnpdepth_cli.pipeline.sparse.outputs import SparseTarget

FILE = click.Path(path_type=Path)
SEED = click.IntRange(0, LARGEST_SEED)


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
    groups = (FrameFiles, NetworkChoice, MethodOptions, HoldOut, OutputOptions)
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
    show_default=_MODEL.default,
    metavar=_MODEL.option.metavar,
    help=f"{_MODEL.option.help} Given several times, all compete and are blended.",
)
checkpoint = _only(NetworkChoice, "checkpoint")
precision = _only(NetworkChoice, "precision")
device = _only(NetworkChoice, "device")
layer = _only(MethodOptions, "layer")
depth_scale = _only(FrameFiles, "depth_scale")
channel = _only(FrameFiles, "channel")
seed = _only(HoldOut, "seed")
overwrite = _only(OutputOptions, "overwrite")
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
output_scale = click.option(
    "--output-scale",
    type=float,
    default=256.0,
    show_default=True,
    metavar="S",
    help="A written PNG holds metres × S.",
)
sparse_output = click.option(
    "-o",
    "--output",
    type=FILE,
    required=True,
    help="Sparse depth file: PNG, EXR, NPY, NPZ, PFM or TIFF map, or CSV rows x y depth.",
)
camera = click.option(
    "--camera", type=int, metavar="N", help="KITTI camera number, 0 to 3.  [default: 2]"
)
euclidean = click.option(
    "--range",
    "euclidean",
    is_flag=True,
    help="Depth is the distance from the camera, not z.",
)
max_range = click.option(
    "--max-range",
    type=float,
    metavar="M",
    help="Drop points farther than M metres.",
)

_SCAN_OPTIONS = (
    click.option(
        "--calib",
        type=FILE,
        metavar="FILE|FOLDER",
        help="Calibration of a LiDAR scan: a KITTI file or raw folder, or a file with K, R, t.",
    ),
    camera,
    euclidean,
    click.option(
        "--keep-occluded",
        is_flag=True,
        help="Keep scan points that are occluded from the camera.",
    ),
    click.option(
        "--min-range",
        type=float,
        default=0.0,
        metavar="M",
        help="Drop points nearer than M metres.",
    ),
    max_range,
    click.option(
        "--point-fields",
        type=click.IntRange(3, 64),
        metavar="N",
        help="Float32 numbers of a point in a .bin: KITTI 4, nuScenes 5.  [default: recognised]",
    ),
    max_pixels,
)


def scan(command: Callable[..., Any]) -> Callable[..., Any]:
    """Adds the options of a LiDAR scan; `scan_given` separates them from the others."""
    for option in reversed(_SCAN_OPTIONS):
        command = option(command)
    return command


def scan_given(given: dict[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Returns (the options of a LiDAR scan, the others)."""
    names = (
        *("calib", "camera", "euclidean", "keep_occluded", "min_range", "max_range"),
        "point_fields",
    )
    return (
        {name: given[name] for name in names},
        {name: value for name, value in given.items() if name not in names},
    )


def request_of(given: dict[str, Any], **others: Any) -> RefineRequest:
    """Returns the request that these options of a command make.

    Args:
        given: Values of the options of `scan` and `options_of_groups`, by their names.
        **others: Other fields of the request.
    """
    from pnpdepth_cli.pipeline.sparse.scans import ScanOptions

    scan_options, rest = scan_given(given)
    if isinstance(rest.get("model"), tuple):  # of the commands that take several
        rest["model"], *more = rest["model"]
        rest["more_models"] = tuple(more)
    return RefineRequest.from_fields(scan=ScanOptions(**scan_options), **rest, **others)


def sparse_target(given: dict[str, Any]) -> SparseTarget:
    """Returns where sparse depth is written; its options are taken out of `given`."""
    from pnpdepth_cli.pipeline.sparse.outputs import SparseTarget

    return SparseTarget(
        output=given.pop("output"),
        overlay=given.pop("overlay", None),
        depth_scale=given.pop("output_scale"),
        overwrite=given.pop("overwrite"),
    )


def height_and_width(text: str) -> tuple[int, int]:
    """Returns (H, W) from a text such as 480x640. Raises UsageError for any other text."""
    height, x, width = text.lower().partition("x")
    if not (x and height.isdecimal() and width.isdecimal() and int(height) and int(width)):
        raise UsageError(f"size {text!r} is not of the form HxW, such as 480x640")
    return int(height), int(width)


def count_or_share(text: str | None) -> tuple[int | None, float | None]:
    """Returns (count, None) for `500`, (None, fraction) for `5%`. Raises UsageError otherwise."""
    return (None, None) if text is None else request.count_or_share(text)
