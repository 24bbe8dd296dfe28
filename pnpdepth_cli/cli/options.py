"""Options that several commands share, each defined once."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

from pnpdepth_cli.choices import (
    ALIGNMENTS,
    FORMATS,
    LOSSES,
    NORMALISATIONS,
    PARAMETERS,
    PRECISIONS,
    SCHEDULES,
    SPACES,
    UPDATES,
)
from pnpdepth_cli.errors import UsageError

FILE = click.Path(path_type=Path)
SEED = click.IntRange(0, 2**32 - 1)

model = click.option(
    "--model",
    default="compact",
    show_default=True,
    metavar="NAME|FILE|FOLDER",
    help="A network that `pnpdepth models` lists; FILE.py[:ATTR] with a definition or a torch"
    " module; FILE.onnx[:OUTPUT]; FILE.pt2; or a Hugging Face folder.",
)
checkpoint = click.option(
    "--checkpoint",
    type=FILE,
    help="Its weights: .safetensors, a torch, numpy or TensorFlow (.index) file, or a folder with"
    " one file per part; nothing in them is run.",
)
layer = click.option(
    "--layer",
    metavar="NAME|0..1",
    help="Where to cut: a submodule's name (NAME#2 its second call, NAME[KEY] one of several"
    " outputs), or a share of the definition's layers, 0 the shallowest.",
)
_READING_OPTIONS = (
    click.option(
        "--align",
        type=click.Choice(ALIGNMENTS),
        help="Fit the network's output to the points: a factor, or a factor and a shift."
        "  [default: the network's own; none where it gives metres]",
    ),
    click.option("--align-every", is_flag=True, help="Fit again at every update of z."),
    click.option(
        "--output-kind",
        type=click.Choice(SPACES),
        help="What the network's output is, over what is known of it.",
    ),
    click.option(
        "--normalise",
        type=click.Choice(NORMALISATIONS),
        help="The rgb that the network wants: 0…1, ImageNet's, −1…1, 0…255.",
    ),
)


def reading(command: Callable[..., Any]) -> Callable[..., Any]:
    """The command has the options of how a network's input and output are to be read."""
    for option in reversed(_READING_OPTIONS):
        command = option(command)
    return command


device = click.option("--device", default="cpu", show_default=True, help="cpu, cuda, cuda:1, mps …")
precision = click.option(
    "--precision",
    type=click.Choice(PRECISIONS),
    default="fp32",
    show_default=True,
    help="Of the network's convolutions and matrix products; z, loss and updates stay in fp32.",
)
as_json = click.option("--json", "as_json", is_flag=True, help="Print the result as JSON.")
overwrite = click.option("--overwrite", is_flag=True, help="Replace results that exist.")
depth_scale = click.option(
    "--depth-scale",
    type=float,
    metavar="S",
    help="Integer depth files hold metres × S.  [default: what the file says, else 256]",
)
channel = click.option(
    "--channel", metavar="NAME", help="Which EXR channel or NPZ array holds the depth."
)
output_scale = click.option(
    "--output-scale",
    type=float,
    default=256.0,
    show_default=True,
    metavar="S",
    help="A PNG holds metres × S.",
)
sparse_output = click.option(
    "-o",
    "--output",
    type=FILE,
    required=True,
    help="Sparse depth: PNG, EXR, NPY, NPZ, PFM, TIFF; or CSV, points x y depth.",
)
camera = click.option(
    "--camera", type=int, metavar="N", help="Of KITTI's four, 0 to 3.  [default: 2]"
)
euclidean = click.option(
    "--range", "euclidean", is_flag=True, help="Depth is the distance from the camera, not z."
)
max_range = click.option(
    "--max-range", type=float, metavar="M", help="Drop points farther from the scanner, metres."
)

_SCAN_OPTIONS = (
    click.option(
        "--calib",
        type=FILE,
        metavar="FILE|FOLDER",
        help="For a LiDAR scan: KITTI's calibration, its raw folder, or a file with K, R and t.",
    ),
    camera,
    euclidean,
    click.option(
        "--keep-occluded",
        is_flag=True,
        help="Keep a scan's points that the camera sees something nearer in front of.",
    ),
    click.option(
        "--min-range", type=float, default=0.0, metavar="M", help="Drop nearer points of a scan."
    ),
    max_range,
)


def scan(command: Callable[..., Any]) -> Callable[..., Any]:
    """The command has the options of a LiDAR scan; `scan_given` takes them out of the rest."""
    for option in reversed(_SCAN_OPTIONS):
        command = option(command)
    return command


def scan_given(given: dict[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """(the options of a LiDAR scan, the others) of what the user gave."""
    names = ("calib", "camera", "euclidean", "keep_occluded", "min_range", "max_range")
    return (
        {name: given[name] for name in names},
        {name: value for name, value in given.items() if name not in names},
    )


PROPAGATIONS = ("none", "gp", "diffusion")


def _seconds(context: click.Context, parameter: click.Parameter, text: str | None) -> float | None:
    """The seconds of `5`, `5s` or `500ms`. UsageError for any other text."""
    if text is None:
        return None
    number, unit = (text[:-2], 1e-3) if text.endswith("ms") else (text.removesuffix("s"), 1.0)
    try:
        seconds = float(number) * unit
    except ValueError:
        seconds = -1.0
    if not 0 < seconds < float("inf"):
        raise UsageError(f"time budget {text!r} is no time; give seconds, such as 5s")
    return seconds


_REFINEMENT_OPTIONS = (
    click.option(
        "--format",
        type=click.Choice(list(FORMATS)),
        default="png",
        show_default=True,
        help="Of the depth file in a folder.",
    ),
    overwrite,
    model,
    checkpoint,
    layer,
    click.option(
        "--iterations", type=int, metavar="K", help="Updates of z; 0 gives the plain prediction."
    ),
    click.option(
        "--lr", metavar="NUMBER|P%", help="Step: absolute, or per cent of z's standard deviation."
    ),
    click.option(
        "--loss", type=click.Choice(tuple(LOSSES)), help="Between prediction and sparse points."
    ),
    click.option(
        "--update",
        type=click.Choice(tuple(UPDATES)),
        help="From gradient to step; one that is not the network's default starts from the paper's"
        " --lr, --schedule and --spread.",
    ),
    click.option(
        "--schedule", type=click.Choice(SCHEDULES), help="Of the step: it stays, or falls to 0."
    ),
    click.option(
        "--spread",
        type=float,
        metavar="S",
        help="Blur the gradient over S spacings of the points, where z is a map; 0 does not.",
    ),
    click.option(
        "--parameters",
        type=click.Choice(PARAMETERS),
        default="elements",
        show_default=True,
        help="What is updated: every element of z, or a scale and a shift of each channel.",
    ),
    click.option(
        "--anchor",
        type=float,
        default=0.0,
        metavar="W",
        help="Add to the loss W times the mean squared change of log depth: stay near the network.",
    ),
    click.option(
        "--line-search", is_flag=True, help="Take back updates that raise the loss; go half as far."
    ),
    click.option(
        "--keep-best", is_flag=True, help="Give the depth of the lowest loss, not the last."
    ),
    click.option(
        "--propagate",
        type=click.Choice(PROPAGATIONS),
        help="Spread what is left at the points: by a Gaussian process, or by diffusion that stops"
        " at edges.  [default: none; with --auto what is best]",
    ),
    click.option(
        "--auto",
        is_flag=True,
        help="Choose alignment, updates and propagation, or a baseline, by points held out in"
        " turns; never worse at those than the network and every baseline.",
    ),
    click.option(
        "--time-budget",
        "time_budget_s",
        metavar="SECONDS",
        callback=_seconds,
        help="With --auto: try more layers and steps for so long, such as 5s.",
    ),
    click.option(
        "--baselines", is_flag=True, help="Score every simple baseline beside the result."
    ),
    click.option(
        "--uncertainty",
        is_flag=True,
        help="Write <name>_sigma.exr, the depth's standard deviation.",
    ),
    reading,
    depth_scale,
    click.option("--gt-scale", type=float, metavar="S", help="The same for the ground truth."),
    channel,
    click.option(
        "--sparse-size-ok", is_flag=True, help="Map points of a sparse map of another size."
    ),
    click.option(
        "--holdout",
        type=float,
        default=0.0,
        metavar="F",
        help="Keep this share of the points out, and score them.",
    ),
    click.option("--seed", type=SEED, default=0, show_default=True, help="Of the hold-out choice."),
    click.option(
        "--tile",
        type=click.IntRange(min=64),
        metavar="PIXELS",
        help="Refine a frame larger than that in tiles of this side, where memory is short.",
    ),
    precision,
    device,
)


def refinement(command: Callable[..., Any]) -> Callable[..., Any]:
    """The command has the options of how a frame is refined; they are named as in RefineRequest."""
    for option in reversed(_REFINEMENT_OPTIONS):
        command = option(command)
    return command


def height_and_width(text: str) -> tuple[int, int]:
    """(H, W) of a text such as 480x640. UsageError for any other."""
    height, x, width = text.lower().partition("x")
    if not (x and height.isdecimal() and width.isdecimal() and int(height) and int(width)):
        raise UsageError(f"size {text!r} is not of the form HxW, such as 480x640")
    return int(height), int(width)


def count_or_share(text: str | None) -> tuple[int | None, float | None]:
    """(points, share) of `500` or `5%`; None for what it is not. UsageError for any other text."""
    from pnpdepth_cli.pipeline.refinement import request

    return (None, None) if text is None else request.count_or_share(text)
