"""`pnpdepth refine`: the options, and what is printed of one image."""

from __future__ import annotations

from typing import Any

import click

from pnpdepth_cli.cli import options
from pnpdepth_cli.cli.terminal import print_json
from pnpdepth_cli.commands.requests.refine_request import RefineRequest
from pnpdepth_cli.dataset.frame_files import ReadOptions, ScanOptions
from pnpdepth_cli.errors import DivergedError
from pnpdepth_cli.settings import Settings


@click.command(
    "refine",
    short_help="Refine the depth of one image.",
    cls=options.GroupedCommand,
    common=(
        "--sparse",
        "--depth",
        "--gt",
        "--calib",
        "--model",
        "--checkpoint",
        "--method",
        "--layer",
        "--holdout",
        "--uncertainty",
        "--output",
        "--overwrite",
        "--json",
    ),
    groups={
        "Input": (
            "--sparse",
            "--sparse-mask",
            "--min-confidence",
            "--depth",
            "--gt",
            ScanOptions,
            ReadOptions,
        ),
        "Network": options.NETWORK,
        "Method": (Settings, "--uncertainty", "--keep-measured", "--holdout"),
        "Output": ("--output", RefineRequest, "--json"),
    },
)
@click.argument("image", type=options.FILE, required=False)
@click.option(
    "--sparse",
    type=options.FILE,
    required=True,
    help="Sparse depth: a map (16-bit PNG, EXR, NPY, …), points x y depth (NPY, CSV), a LiDAR scan"
    " with --calib (BIN, NPY, PCD, PLY), or the folder of a COLMAP model.",
)
@click.option(
    "--sparse-mask",
    type=options.FILE,
    help="Confidence of the sparse depth, or a mask: image or array of its size or the image's.",
)
@options.min_confidence
@click.option(
    "--depth",
    "depths",
    type=options.FILE,
    multiple=True,
    help="Depth map that a network predicted (NPY, NPZ, EXR, 16-bit PNG, …; FILE.npz:KEY): depth or"
    " disparity in any unit, which takes the place of a network's output. Several are fused.",
)
@click.option("--gt", type=options.FILE, help="Ground truth depth to score against.")
@click.option(
    "-o",
    "--output",
    type=options.FILE,
    help="Output folder, or one depth file such as depth.exr.  [default: ./IMAGE_refined/]",
)
@options.refinement(without=["seed", "baselines", "format"])
@options.as_json
def command(as_json: bool, **values: Any) -> None:
    """Refine a depth network's prediction for IMAGE with sparse depth.

    \b
    pnpdepth refine img.png --sparse s.png
    pnpdepth refine img.png --sparse s.exr --gt gt.png -o out/
    pnpdepth refine img.png --sparse s.csv --depth predicted.npy
    pnpdepth refine img.png --sparse s.npy --model net.onnx --layer Relu_315
    pnpdepth refine 000001.png --sparse 000001.bin --calib 000001.txt

    Writes <name>_depth.png (16 bit, with its scale), <name>_preview.png, <name>.json and
    <name>_improvement.png (blue better, orange worse): with ground truth at each pixel, else at
    held-out or validation points.
    """
    from pnpdepth_cli.cli.printing import print_refinement
    from pnpdepth_cli.commands.refine import refine_image  # imports torch

    request = options.request_of(values)
    record = refine_image(request)
    if as_json:
        print_json(record.to_json())
    else:
        print_refinement(record)
    if record.status == "diverged":
        raise DivergedError(record.message or "")
