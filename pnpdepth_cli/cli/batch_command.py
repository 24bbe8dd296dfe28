"""`pnpdepth batch`."""

from __future__ import annotations

import os
import signal
import threading
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from types import FrameType
from typing import TYPE_CHECKING, Any

import click

from pnpdepth_cli.cli import grouped_help, options
from pnpdepth_cli.cli.terminal import INTERRUPTED, BatchProgress, progress_bar, say
from pnpdepth_cli.cli.vary import Combination, combinations_of
from pnpdepth_cli.commands.batch.batch_request import BatchRequest
from pnpdepth_cli.commands.refinement.refine_request import (
    HoldOut,
    NetworkChoice,
    OutputOptions,
    parse_sample,
)
from pnpdepth_cli.dataset.read_options import ReadOptions, ScanOptions
from pnpdepth_cli.errors import FramesFailedError, StorageError
from pnpdepth_cli.settings import Settings

if TYPE_CHECKING:
    from pnpdepth_cli.commands.batch.summary import BatchSummary

_STOPPING = b"\nfinishing the current frame; press Ctrl-C again to stop at once\n"


@click.command(
    short_help="Refine all frames of a folder or a list.",
    cls=grouped_help.GroupedCommand,
    common=frozenset(
        {
            *("--layout", "--sample", "--limit", "--shard", "--model", "--checkpoint", "--method"),
            *("--holdout", "--uncertainty", "--output", "--html", "--vary"),
        }
    ),
    groups={
        "Frames": (
            *("--sample", "--layout", "--protocol", "--frames", "--every", "--limit", "--shard"),
        ),
        "Sequences": ("--accumulate", "--poses", "--pose-kind", "--adapt"),
        "Input": (ScanOptions, ReadOptions),
        "Network": (NetworkChoice,),
        "Method": (Settings, HoldOut),
        "Study": ("--vary",),
        "Output": ("--output", OutputOptions, BatchRequest),
        "Cluster": ("--ray",),
    },
)
@click.argument("source", type=options.FILE, metavar="FOLDER|LIST|BAG")
@click.option("-o", "--output", type=options.FILE, required=True, help="Output folder.")
@click.option(
    "--sample",
    metavar="[PATTERN:]N|P%",
    help="Sample the sparse depth from the ground truth, as `pnpdepth sample` does.",
)
@options.options_of_groups(BatchRequest)
@click.option(
    "--vary",
    multiple=True,
    metavar="NAME=VALUE,…",
    help="Refine with each value of an option of the method, network or points, or without it:"
    " default. Several --vary make all combinations, each in a folder of OUTPUT.",
)
@options.refinement(without=["camera"])
@click.pass_context
def batch(context: click.Context, /, vary: tuple[str, ...], **values: Any) -> None:
    """Refine all frames of FOLDER, of a LIST of them (CSV), or of a ROS BAG.

    \b
    pnpdepth batch drive_0001/ -o out/
    pnpdepth batch frames.csv -o out/ --model net.onnx
    pnpdepth batch kitchen/ -o out/ --sample 500          # sparse depth from the ground truth
    pnpdepth batch drive_0001/ -o out/ --shard 1/4        # one of four processes
    pnpdepth batch drive_0001/ -o out/ --ray              # all devices of this machine
    pnpdepth batch drive_0001/ -o out/ --html report/     # then open report/index.html
    pnpdepth batch frames.csv -o study/ --vary method=fused,paper --vary sample=20,100,500

    The layout of a folder is recognised from its content. The simplest layout has files of the same
    stem in rgb/, sparse/, gt/ (optional) and calib/ (optional). A list has a header with image,
    sparse, gt, calib, name, …; paths are relative to the list.

    Each frame gets the files that `pnpdepth refine` writes. A frame that cannot be refined is
    reported and skipped (exit code 7). The same command run again refines only frames that are
    missing or whose settings or files have changed. OUTPUT/summary.json and OUTPUT/summary.csv list
    all frames; the record NAME.json beside a result says how it was made.
    """
    requests = [
        _request_of(values | combination.values, combination)
        for combination in combinations_of(context, vary)
    ]
    summaries = []
    with _finishing_on_interrupt() as pressed:
        for request in requests:
            summary, stopped = _run(request, pressed)
            summaries.append(summary)
            if stopped or pressed():
                break
    if stopped or len(summaries) < len(requests):
        raise click.exceptions.Exit(INTERRUPTED)
    counts = sum((Counter(summary.counts) for summary in summaries), Counter[str]())
    bad = [f"{counts[kind]:,} {kind}" for kind in ("failed", "diverged") if counts[kind]]
    if bad:
        from pnpdepth_cli.commands.tables import count_of

        raise FramesFailedError(
            f"{' and '.join(bad)} of {count_of(counts['frames'], 'frame')}; the reasons are in"
            f" {values['output']}{'/*' if vary else ''}/summary.csv; run the same command to retry"
            " the failed frames"
        )


def _request_of(values: dict[str, Any], combination: Combination) -> BatchRequest:
    """Returns the request of these options and varied ones, with the frames of a bag unpacked."""
    from pnpdepth_cli.commands.batch.find_frames import unpack

    own = options.take_options(BatchRequest, values)
    own |= {name: values.pop(name) for name in ("source", "output")}
    text = values.pop("sample")
    sample = None if text is None else parse_sample(text)
    request = BatchRequest(refine=options.request_of(values, sample=sample), **own)
    request = unpack(request, say)
    if not combination.texts:
        return request
    return replace(
        request,
        varied=combination.texts,
        output=request.output / combination.folder,
        html=request.html and request.html / combination.folder,
    )


def _run(request: BatchRequest, pressed: Callable[[], bool]) -> tuple[BatchSummary, bool]:
    """Returns the batch's summary, which it prints, and whether the batch was stopped."""
    from pnpdepth_cli.cli.printing import print_batch
    from pnpdepth_cli.commands.batch.run_batch import run_batch
    from pnpdepth_cli.commands.tables import count_of

    with progress_bar("batch", "frame") as show:
        progress = BatchProgress(show)
        try:
            summary = run_batch(request, progress, pressed)
        except StorageError as error:
            raise StorageError(f"{error}; run the same command to continue") from error
        except KeyboardInterrupt:
            say("stopped; run the same command to continue")
            raise click.exceptions.Exit(INTERRUPTED) from None
    print_batch(summary)
    if request.html is not None:
        say(f"wrote {request.html / 'index.html'}")
    stopped = progress.done < progress.to_do
    if stopped:
        count = f"{progress.done:,} of {count_of(progress.to_do, 'frame')}"
        say(f"stopped after {count}; run the same command to continue")
    return summary, stopped


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
