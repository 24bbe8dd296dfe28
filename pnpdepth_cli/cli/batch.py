"""`pnpdepth batch`."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType
from typing import Any

import click

from pnpdepth_cli.cli import grouped_help, options
from pnpdepth_cli.cli.streams import INTERRUPTED, print_json, printable, say
from pnpdepth_cli.commands.batch.request import (
    BatchRequest,
    ClusterOptions,
    FrameSelection,
    SequenceOptions,
)
from pnpdepth_cli.commands.refinement.request import (
    FrameFiles,
    HoldOut,
    NetworkChoice,
    OutputOptions,
    parse_sample,
)
from pnpdepth_cli.commands.sparse.options import BagOptions, ColmapOptions, ScanOptions
from pnpdepth_cli.errors import FramesFailedError, StorageError
from pnpdepth_cli.settings import Settings

_STOPPING = b"\nfinishing the current frame; press Ctrl-C again to stop at once\n"


@click.command(
    short_help="Refine all frames of a folder or a list.",
    cls=grouped_help.GroupedCommand,
    common=grouped_help.COMMON - {"--sparse", "--gt"}
    | {"--layout", "--sample", "--limit", "--shard", "--html", "--workers", "--dry-run"},
    groups={
        "Frames": ("--sample", FrameSelection, "--shard", BagOptions),
        "Sequences": (SequenceOptions, "--adapt"),
        "Input": (ScanOptions, ColmapOptions, FrameFiles),
        "Network": (NetworkChoice,),
        "Method": (Settings, "--set", HoldOut),
        "Output": ("--output", OutputOptions, "--json", "--html", "--html-3d"),
        "Run": (BatchRequest, "--dry-run"),
        "Cluster": (ClusterOptions,),
    },
)
@click.argument("source", type=options.FILE, metavar="FOLDER|LIST|BAG")
@click.option("-o", "--output", type=options.FILE, required=True, help="Output folder.")
@options.sample
@options.options_of_groups(BatchRequest, SequenceOptions, ClusterOptions, BagOptions)
@click.option("--dry-run", is_flag=True, help="List the frames that would be refined, and exit.")
@options.scan
@options.refinement
@options.as_json
def batch(
    source: Path,
    output: Path,
    sample: str | None,
    dry_run: bool,
    as_json: bool,
    **values: Any,
) -> None:
    """Refine all frames of FOLDER, of a LIST of them (CSV or JSON lines), or of a ROS BAG.

    \b
    pnpdepth batch drive_0001/ -o out/
    pnpdepth batch frames.csv -o out/ --workers 4 --model net.onnx
    pnpdepth batch kitchen/ -o out/ --sample 500          # sparse depth from the ground truth
    pnpdepth batch drive_0001/ -o out/ --shard 1/4        # one of four processes
    pnpdepth batch drive_0001/ -o out/ --ray              # all devices of this machine
    pnpdepth batch drive_0001/ -o out/ --html report/     # then open report/index.html

    The layout of a folder is recognised from its content. The simplest layout has files of the same
    stem in rgb/, sparse/, gt/ (optional) and calib/ (optional). A list has a header with image,
    sparse, gt, calib, name, …; paths are relative to the list.

    Each frame gets the files that `pnpdepth refine` writes. A frame that cannot be refined is
    reported and skipped (exit code 7). The same command run again refines only frames that are
    missing or whose settings or files have changed. OUTPUT/summary.json and OUTPUT/summary.csv list
    all frames; the record NAME.json beside a result says how it was made.
    """
    from pnpdepth_cli.commands.batch.batch import plan_batch
    from pnpdepth_cli.commands.batch.frames import unpacked

    own = options.taken(BatchRequest, values)
    own["cluster"] = ClusterOptions(**options.taken(ClusterOptions, values))
    bag_options = BagOptions(**options.taken(BagOptions, values))
    own["sequence"] = SequenceOptions(**options.taken(SequenceOptions, values))
    refine = options.request_of(values, sample=parse_sample(sample))
    request = BatchRequest(source=source, output=output, refine=refine, **own)
    request = unpacked(
        request,
        bag_options,
        say,
        may_write=not dry_run,
    )
    if dry_run:
        planned = plan_batch(request, say)
        if as_json:
            print_json([{"name": name, "why": why} for name, why in planned])
        else:
            for name, why in planned:
                click.echo(f"{printable(name)}  ({printable(why)})")
        return
    raise click.exceptions.Exit(_run(request, as_json))


def _run(request: BatchRequest, as_json: bool) -> int:
    """Runs the batch and prints its summary. Returns the exit code."""
    from pnpdepth_cli.cli.progress import BatchProgress
    from pnpdepth_cli.cli.tables import print_batch, print_profile
    from pnpdepth_cli.commands.batch.batch import run_batch

    with BatchProgress() as progress, _finishing_on_interrupt() as stopped:
        try:
            outcome = run_batch(request, progress, stopped)
        except StorageError as error:
            raise StorageError(f"{error}; run the same command to continue") from error
        except KeyboardInterrupt:
            click.echo("stopped; run the same command to continue", err=True)
            return INTERRUPTED
    counts = outcome.summary["counts"]
    if as_json:
        print_json(outcome.summary)
    else:
        print_batch(outcome.summary)
    if request.profile:
        print_profile(outcome.summary["profile"])
    if request.html is not None:
        say(f"wrote {request.html / 'index.html'}")
    if outcome.stopped:
        click.echo(
            f"stopped after {progress.done:,} of {progress.to_do:,} frames; run the same command"
            " to continue",
            err=True,
        )
        return INTERRUPTED
    bad = [f"{counts[kind]:,} {kind}" for kind in ("failed", "diverged") if counts[kind]]
    if bad:
        raise FramesFailedError(
            f"{' and '.join(bad)} of {counts['frames']:,} frames; the reasons are in"
            f" {request.output}/summary.csv; run the same command to retry the failed frames"
        )
    return 0


@contextmanager
def _finishing_on_interrupt() -> Iterator[Callable[[], bool]]:
    """Yields a function that returns whether Ctrl-C was pressed; pressed again, it interrupts."""
    pressed = threading.Event()

    def handle(number: int, frame: FrameType | None) -> None:
        if pressed.is_set():
            raise KeyboardInterrupt
        pressed.set()
        with suppress(OSError):
            os.write(2, _STOPPING)  # not through the buffered stderr, which may be in use

    before = signal.signal(signal.SIGINT, handle)
    try:
        yield pressed.is_set
    finally:
        signal.signal(signal.SIGINT, before)
