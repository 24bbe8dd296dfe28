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
    metavar="NETWORK",
    help="A name of `pnpdepth models`, FILE.onnx[:OUTPUT], FILE.pt2, a Hugging Face folder, or"
    " FILE.py[:ATTR], which is Python code and is run.",
)
checkpoint = click.option(
    "--checkpoint",
    type=FILE,
    help="Weights: a safetensors, torch, numpy or TensorFlow (.index) file, or a folder of them. No"
    " code in them is run.",
)
layer = click.option(
    "--layer",
    metavar="NAME|0..1",
    help="Layer to cut at: the name of a submodule (NAME#2: its second call, NAME[KEY]: one of its"
    " outputs), or a fraction of the network's depth, 0 the shallowest layer.",
)
_READING_OPTIONS = (
    click.option(
        "--align",
        type=click.Choice(ALIGNMENTS),
        help="Fit the network's output to the points by scale, or scale and shift."
        "  [default: the network's own]",
    ),
    click.option("--align-every", is_flag=True, help="Repeat the alignment at every update of z."),
    click.option(
        "--output-kind",
        type=click.Choice(SPACES),
        help="Meaning of the network's output, replacing what its definition says.",
    ),
    click.option(
        "--normalise",
        type=click.Choice(NORMALISATIONS),
        help="RGB range of the network's input: 0…1, ImageNet's mean and std, −1…1, 0…255.",
    ),
)


def reading(command: Callable[..., Any]) -> Callable[..., Any]:
    """Adds the options for how a network's input and output are interpreted."""
    for option in reversed(_READING_OPTIONS):
        command = option(command)
    return command


device = click.option(
    "--device", default="cpu", show_default=True, metavar="NAME", help="cpu, cuda, cuda:1, mps, …"
)
precision = click.option(
    "--precision",
    type=click.Choice(PRECISIONS),
    default="fp32",
    show_default=True,
    help="Precision of convolutions and matrix products; z, loss and updates stay in fp32.",
)
as_json = click.option("--json", "as_json", is_flag=True, help="Print the result as JSON.")
overwrite = click.option("--overwrite", is_flag=True, help="Replace existing results.")
depth_scale = click.option(
    "--depth-scale",
    type=float,
    metavar="S",
    help="Integer depth files hold metres × S.  [default: from the file, else 256]",
)
channel = click.option(
    "--channel", metavar="NAME", help="EXR channel or NPZ array that holds the depth."
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
)


def scan(command: Callable[..., Any]) -> Callable[..., Any]:
    """Adds the options of a LiDAR scan; `scan_given` separates them from the others."""
    for option in reversed(_SCAN_OPTIONS):
        command = option(command)
    return command


def scan_given(given: dict[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Returns (the options of a LiDAR scan, the others)."""
    names = ("calib", "camera", "euclidean", "keep_occluded", "min_range", "max_range")
    return (
        {name: given[name] for name in names},
        {name: value for name, value in given.items() if name not in names},
    )


PROPAGATIONS = ("none", "gp", "diffusion")


def _seconds(context: click.Context, parameter: click.Parameter, text: str | None) -> float | None:
    """Returns the seconds in `5`, `5s` or `500ms`. Raises UsageError for any other text."""
    if text is None:
        return None
    number, unit = (text[:-2], 1e-3) if text.endswith("ms") else (text.removesuffix("s"), 1.0)
    try:
        seconds = float(number) * unit
    except ValueError:
        seconds = -1.0
    if not 0 < seconds < float("inf"):
        raise UsageError(f"time budget {text!r} is not a duration; give seconds, such as 5s")
    return seconds


_REFINEMENT_OPTIONS = (
    click.option(
        "--format",
        type=click.Choice(list(FORMATS)),
        default="png",
        show_default=True,
        help="Format of the depth file in an output folder.",
    ),
    overwrite,
    model,
    checkpoint,
    layer,
    click.option(
        "--iterations",
        type=int,
        metavar="K",
        help="Number of updates of z; 0 is no refinement.",
    ),
    click.option(
        "--lr",
        metavar="NUMBER|P%",
        help="Step size: absolute, or % of the std of z.",
    ),
    click.option("--loss", type=click.Choice(tuple(LOSSES)), help="Loss at the sparse points."),
    click.option(
        "--update",
        type=click.Choice(tuple(UPDATES)),
        help="Update rule; another than the network's resets --lr, --schedule and --spread.",
    ),
    click.option(
        "--schedule",
        type=click.Choice(SCHEDULES),
        help="Step size over the updates; linear decays to 0.",
    ),
    click.option(
        "--spread",
        type=float,
        metavar="S",
        help="Blur the gradient over S times the spacing of the points; 0 is off.",
    ),
    click.option(
        "--parameters",
        type=click.Choice(PARAMETERS),
        default="elements",
        show_default=True,
        help="Update every element of z, or a scale and a shift of each channel.",
    ),
    click.option(
        "--anchor",
        type=float,
        default=0.0,
        metavar="W",
        help="Add W times the mean squared change of log depth to the loss.",
    ),
    click.option(
        "--line-search", is_flag=True, help="Undo updates that raise the loss and halve the step."
    ),
    click.option(
        "--keep-best", is_flag=True, help="Return the depth with the lowest loss, not the last."
    ),
    click.option(
        "--propagate",
        type=click.Choice(PROPAGATIONS),
        help="Propagate the residuals at the points to all pixels: Gaussian process or edge-aware"
        " diffusion.  [default: none; chosen by --auto]",
    ),
    click.option(
        "--auto",
        is_flag=True,
        help="Choose alignment, updates and propagation by cross-validation over the points.",
    ),
    click.option(
        "--time-budget",
        "time_budget_s",
        metavar="SECONDS",
        callback=_seconds,
        help="With --auto: also try other layers and step sizes for this long, such as 5s.",
    ),
    click.option(
        "--baselines", is_flag=True, help="Also score every baseline, such as linear interpolation."
    ),
    click.option(
        "--uncertainty",
        is_flag=True,
        help="Write <name>_sigma.exr, the standard deviation of the depth.",
    ),
    reading,
    depth_scale,
    click.option("--gt-scale", type=float, metavar="S", help="--depth-scale of the ground truth."),
    channel,
    click.option(
        "--sparse-size-ok",
        is_flag=True,
        help="Accept a sparse depth map of another size; its points are moved to the image.",
    ),
    click.option(
        "--holdout",
        type=float,
        default=0.0,
        metavar="F",
        help="Hold out this fraction of the points to score at.",
    ),
    click.option(
        "--seed",
        type=SEED,
        default=0,
        show_default=True,
        metavar="N",
        help="Random seed.",
    ),
    click.option(
        "--tile",
        type=click.IntRange(min=64),
        metavar="PIXELS",
        help="Refine larger frames in overlapping tiles of this side length, to save memory.",
    ),
    precision,
    device,
)


def refinement(command: Callable[..., Any]) -> Callable[..., Any]:
    """Adds the options for how a frame is refined, named as the fields of RefineRequest."""
    for option in reversed(_REFINEMENT_OPTIONS):
        command = option(command)
    return command


def height_and_width(text: str) -> tuple[int, int]:
    """Returns (H, W) from a text such as 480x640. Raises UsageError for any other text."""
    height, x, width = text.lower().partition("x")
    if not (x and height.isdecimal() and width.isdecimal() and int(height) and int(width)):
        raise UsageError(f"size {text!r} is not of the form HxW, such as 480x640")
    return int(height), int(width)


def count_or_share(text: str | None) -> tuple[int | None, float | None]:
    """Returns (count, None) for `500`, (None, fraction) for `5%`. Raises UsageError otherwise."""
    from pnpdepth_cli.pipeline.refinement import request

    return (None, None) if text is None else request.count_or_share(text)
