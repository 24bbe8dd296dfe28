"""`pnpdepth batch`."""

from __future__ import annotations

import json
import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

import click

from pnpdepth_cli.cli import options
from pnpdepth_cli.cli.exit_codes import INTERRUPTED
from pnpdepth_cli.cli.printable import printable
from pnpdepth_cli.errors import FramesFailedError, StorageError, UsageError

if TYPE_CHECKING:
    from pnpdepth_cli.pipeline.batch.frames import BatchRequest

LAYOUTS = (
    *("manifest", "nyu-mat", "kitti-odometry", "kitti-object", "kitti-depth", "tum", "7scenes"),
    *("synthia", "pairs", "nyu-h5"),
)
PROTOCOLS = ("whole", "nyu", "kitti-odometry", "kitti-depth")
_STOPPING = b"\nfinishing the frame in work; Ctrl-C again stops at once\n"


@click.command(short_help="Refine all frames of a folder or a list.")
@click.argument("source", type=options.FILE, metavar="FOLDER|LIST")
@click.option("-o", "--output", type=options.FILE, required=True, help="The folder for results.")
@click.option("--layout", type=click.Choice(LAYOUTS), help="Of the folder.  [default: guessed]")
@click.option(
    "--protocol",
    type=click.Choice(PROTOCOLS),
    help="What is cut out of the frames first.  [default: the layout's own]",
)
@click.option(
    "--sample",
    metavar="[PATTERN:]N|P%",
    help="Points of the ground truth in place of sparse depth, as `pnpdepth sample` takes them.",
)
@click.option("--limit", type=int, metavar="N", help="Only the first N frames.")
@click.option("--shard", metavar="I/N", help="Every N-th frame from the I-th, 1/N to N/N.")
@click.option(
    "--workers",
    type=int,
    default=2,
    show_default=True,
    metavar="N",
    help="Threads that read, and as many that write.",
)
@click.option(
    "--html",
    type=options.FILE,
    metavar="FOLDER",
    help="A report to open in a browser: every frame before and after, the worst first.",
)
@click.option(
    "--batch-size",
    default="auto",
    show_default=True,
    metavar="auto|N",
    help="Frames of one size that the network takes at once. auto: as many as gain time and leave"
    " every bit of the results as it is.",
)
@click.option("--profile", is_flag=True, help="Say at the end where the time went.")
@click.option("--dry-run", is_flag=True, help="List what would be done, and do nothing.")
@options.scan
@options.refinement
@options.as_json
def batch(
    source: Path,
    output: Path,
    layout: str | None,
    protocol: str | None,
    sample: str | None,
    limit: int | None,
    shard: str | None,
    workers: int,
    batch_size: str,
    profile: bool,
    html: Path | None,
    dry_run: bool,
    as_json: bool,
    **given: Any,
) -> None:
    """Refine all frames of FOLDER, or of a LIST of them (CSV or JSON lines).

    \b
    pnpdepth batch drive_0001/ -o out/
    pnpdepth batch frames.csv -o out/ --workers 4 --model net.onnx
    pnpdepth batch kitchen/ -o out/ --sample 500          # no sparse depth, but ground truth
    pnpdepth batch drive_0001/ -o out/ --shard 1/4        # one of four processes
    pnpdepth batch drive_0001/ -o out/ --html report/     # and report/index.html to look at

    \b
    A folder is known by what is in it; the simplest layout has the same stems in
      rgb/ sparse/ [gt/] [calib/]
    A list has a header with image, sparse, gt, calib, name, …; paths are relative to it.

    For each frame the results are those of `pnpdepth refine`; a frame that cannot be refined is
    told, counted and passed over (exit code 7). The same command again does what is missing, or was
    made with other settings or from other files, and leaves the rest. OUTPUT/summary.json and
    OUTPUT/summary.csv have all frames, OUTPUT/batch.jsonl is the run's memory.
    """
    from pnpdepth_cli.pipeline.batch.batch import plan_batch
    from pnpdepth_cli.pipeline.batch.frames import BatchRequest
    from pnpdepth_cli.pipeline.refinement.request import sample_pattern

    pattern = None if sample is None else sample_pattern(*_sample(sample))
    request = BatchRequest(
        source=source,
        output=output,
        refine=options.request_of(given, sample=pattern),
        layout=layout,
        protocol=protocol,
        workers=workers,
        batch_size=None if batch_size == "auto" else _batch_size(batch_size),
        profile=profile,
        limit=limit,
        shard=None if shard is None else _shard(shard),
        html=html,
    )
    if dry_run:
        planned = plan_batch(request, lambda text: click.echo(printable(text), err=True))
        if as_json:
            click.echo(json.dumps([{"name": p.name, "why": p.why} for p in planned], indent=2))
        else:
            for each in planned:
                click.echo(f"{printable(each.name)}  ({printable(each.why)})")
        return
    raise click.exceptions.Exit(_run(request, as_json))


def _run(request: BatchRequest, as_json: bool) -> int:
    """The exit code of a batch that went to its end, or was stopped by the user."""
    from pnpdepth_cli.cli.progress import BatchProgress
    from pnpdepth_cli.cli.tables import print_batch, print_profile
    from pnpdepth_cli.pipeline.batch.batch import run_batch

    with BatchProgress() as progress, _finishing_on_interrupt() as stopped:
        try:
            outcome = run_batch(request, progress, stopped)
        except StorageError as error:
            raise StorageError(f"{error}; the same command goes on from there") from error
        except KeyboardInterrupt:
            click.echo("stopped; the same command goes on from there", err=True)
            return INTERRUPTED
    counts = outcome.summary["counts"]
    if as_json:
        click.echo(json.dumps(outcome.summary, indent=2))
    else:
        print_batch(outcome.summary)
    if request.profile:
        print_profile(outcome.summary["profile"])
    if request.html is not None:
        click.echo(printable(f"wrote {request.html / 'index.html'}"), err=True)
    if outcome.stopped:
        click.echo(
            f"stopped after {progress.done:,} of {progress.to_do:,} frames; the same command goes"
            " on from there",
            err=True,
        )
        return INTERRUPTED
    bad = [f"{counts[kind]:,} {kind}" for kind in ("failed", "diverged") if counts[kind]]
    if bad:
        raise FramesFailedError(
            f"{' and '.join(bad)} of {counts['frames']:,} frames; {request.output}/summary.csv says"
            " why, and the same command tries the failed ones again"
        )
    return 0


@contextmanager
def _finishing_on_interrupt() -> Iterator[Callable[[], bool]]:
    """Inside, Ctrl-C only makes the yielded function say true; the second time it interrupts."""
    asked = threading.Event()

    def handle(number: int, frame: FrameType | None) -> None:
        if asked.is_set():
            raise KeyboardInterrupt
        asked.set()
        os.write(2, _STOPPING)  # not by the buffered stderr, which may just be in use

    before = signal.signal(signal.SIGINT, handle)
    try:
        yield asked.is_set
    finally:
        signal.signal(signal.SIGINT, before)


def _sample(text: str) -> tuple[str, int | None, float | None]:
    """(pattern, points, share) of `500`, `5%` or `lines:16`."""
    kind, colon, count = text.rpartition(":")
    return kind if colon else "uniform", *options.count_or_share(count)


def _batch_size(text: str) -> int:
    if not text.isdecimal():
        raise UsageError(f"batch size {text!r} is neither auto nor a number of frames such as 8")
    return int(text)


def _shard(text: str) -> tuple[int, int]:
    number, slash, of = text.partition("/")
    if not (slash and number.isdecimal() and of.isdecimal()):
        raise UsageError(f"shard {text!r} is not of the form I/N, such as 1/4")
    return int(number), int(of)
