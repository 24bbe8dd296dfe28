"""`pnpdepth refine`."""

from __future__ import annotations

import json
import time
from types import TracebackType
from typing import TYPE_CHECKING, Any

import click

from pnpdepth_cli.cli import options

if TYPE_CHECKING:
    from tqdm import tqdm


@click.command(short_help="Refine the depth of one image.")
@click.argument("image", type=options.FILE, required=False)
@click.option(
    "--sparse",
    type=options.FILE,
    required=True,
    help="Sparse depth: PNG (16 bit), EXR, NPY, NPZ, PFM, TIFF; points x y depth as NPY, CSV;"
    " or with --calib a LiDAR scan: KITTI's BIN, NPY, PCD, PLY.",
)
@options.scan
@click.option("--gt", type=options.FILE, help="Ground truth: scores and an improvement map.")
@click.option(
    "-o",
    "--output",
    type=options.FILE,
    help="A folder, or one depth file such as depth.exr.  [default: ./IMAGE_refined/]",
)
@options.refinement
@options.as_json
def refine(as_json: bool, **given: Any) -> None:
    """Improve a network's depth of IMAGE with sparse depth.

    \b
    pnpdepth refine img.png --sparse s.png
    pnpdepth refine img.png --sparse s.exr --gt gt.png -o out/
    pnpdepth refine img.png --sparse s.npy --model my_net.py --checkpoint my_net.pt \\
             --layer decoder.up1 --iterations 10 --lr 0.02 --loss l2 --update adam -o depth.exr
    pnpdepth refine 000001.png --sparse 000001.bin --calib 000001.txt

    Writes into the output folder: <name>_depth.png (16 bit; the scale is in the file),
    <name>_preview.png, <name>_improvement.png (red better, green worse) and <name>.json.
    """
    from pnpdepth_cli.cli.tables import print_refinement
    from pnpdepth_cli.pipeline.refinement.refine import refine_image

    request = options.request_of(given)
    with _SlowBar() as bar:
        outcome = refine_image(request, on_iteration=bar.show)
    if as_json:
        click.echo(json.dumps(outcome.record, indent=2))
    else:
        print_refinement(outcome.record)
    if outcome.diverged is not None:
        raise outcome.diverged


class _SlowBar:
    """A bar over the updates of z, shown once they have taken more than a second."""

    def __init__(self) -> None:
        self._start = time.monotonic()
        self._bar: tqdm[Any] | None = None

    def __enter__(self) -> _SlowBar:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._bar is not None:
            self._bar.close()

    def show(self, done: int, of: int, loss: float) -> None:
        if done == 1:
            self._start = time.monotonic()
        if self._bar is None and time.monotonic() - self._start > 1:
            from tqdm import tqdm

            self._bar = tqdm(total=of, initial=done, desc="refine", unit="update", leave=False)
        elif self._bar is not None:
            self._bar.update(done - self._bar.n)
            self._bar.set_postfix_str(f"loss {loss:.4g}")
