"""`pnpdepth batch`: the options, the combinations of `--vary`, Ctrl-C, and what is printed."""

from __future__ import annotations

import itertools
import os
import re
import signal
import threading
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from types import FrameType
from typing import TYPE_CHECKING, Any, NamedTuple

import click
from click.core import ParameterSource

from pnpdepth_cli.cli import options
from pnpdepth_cli.cli.terminal import INTERRUPTED, progress_bar, say, say_above_bar
from pnpdepth_cli.commands.requests.batch_request import BatchRequest, Listener
from pnpdepth_cli.commands.requests.refine_request import RefineRequest, parse_sample
from pnpdepth_cli.dataset.frame_files import ReadOptions, ScanOptions
from pnpdepth_cli.errors import FramesFailedError, UsageError
from pnpdepth_cli.settings import OF_UPDATES, Settings

if TYPE_CHECKING:
    from pnpdepth_cli.commands.many_frames.summary import BatchSummary

DEFAULT = "default"
"""A value of `--vary` that leaves the option out."""
_GROUPS = ("Network", "Method", "Sequences")
"""Groups of the help whose options can be varied, besides --sample."""
_NOT_IN_NAMES = re.compile(r'[<>:"/\\|?*]')
"""Characters that a folder's name cannot have, on some system."""
_STOPPING = b"\nfinishing the current frame; press Ctrl-C again to stop at once\n"


class _Combination(NamedTuple):
    """A value of each option that `--vary` names, for one run of a study."""

    texts: dict[str, str]
    """The values as the user wrote them, by the option's name."""
    parameters: dict[str, object]
    """The same as the command takes them, by its parameter's name; `default` is left out."""


@click.command(
    "batch",
    short_help="Refine all frames of a folder or a list.",
    cls=options.GroupedCommand,
    common=(
        "--layout",
        "--sample",
        "--limit",
        "--shard",
        "--model",
        "--checkpoint",
        "--method",
        "--holdout",
        "--uncertainty",
        "--output",
        "--html",
        "--vary",
    ),
    groups={
        "Frames": (
            "--sample",
            "--layout",
            "--protocol",
            "--frames",
            "--every",
            "--limit",
            "--shard",
        ),
        "Sequences": ("--accumulate", "--poses", "--pose-kind", "--adapt"),
        "Input": ("--min-confidence", ScanOptions, ReadOptions),
        "Network": options.NETWORK,
        "Method": (Settings, "--baselines", "--uncertainty", "--keep-measured", "--holdout"),
        "Study": ("--vary",),
        "Output": ("--output", RefineRequest, BatchRequest),
        "Cluster": ("--ray",),
    },
)
@click.argument("source", type=options.FILE, metavar="FOLDER|LIST|BAG")
@click.option("-o", "--output", type=options.FILE, required=True, help="Output folder.")
@click.option(
    "--sample",
    type=parse_sample,
    metavar="[PATTERN:]N|P%",
    help="Sample the sparse depth from the ground truth, as `pnpdepth sample` does.",
)
@options.min_confidence
@options.options_of_groups(BatchRequest)
@click.option(
    "--vary",
    multiple=True,
    metavar="NAME=VALUE,…",
    help="Refine with each value of an option of the method, network or points, or without it:"
    " default. Several --vary make all combinations, each in a folder of OUTPUT; those that are"
    " equal, as without updates of z, are one.",
)
@options.refinement(without=["camera"])
@click.pass_context
def command(context: click.Context, /, vary: tuple[str, ...], **values: Any) -> None:
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
    sparse, gt, calib, name, …; paths are relative to the list. The frames of a BAG are written to
    OUTPUT_frames/, beside OUTPUT, and stay there for the next run.

    Each frame gets the files that `pnpdepth refine` writes. A frame that cannot be refined is
    reported and skipped (exit code 7). The same command run again refines only frames that are
    missing or whose settings or files have changed. OUTPUT/summary.json and OUTPUT/summary.csv list
    all frames; the record NAME.json beside a result says how it was made.
    """
    # A run for each combination of varied values; one run if nothing is varied.
    requests = [
        _request_of(values | combination.parameters, folder, combination.texts)
        for folder, combination in _combinations(context, vary).items()
    ]
    summaries: list[BatchSummary] = []
    printed = set[str]()
    with _finishing_on_interrupt() as is_interrupted:
        for number, request in enumerate(requests, start=1):
            if len(requests) > 1:
                say(f"run {number:,} of {len(requests):,}: {request.output.name}")
            summary, is_stopped = _run(request, is_interrupted, printed)
            summaries.append(summary)
            if is_stopped or is_interrupted():
                break
    # The exit code: interrupted, some frames failed, or done.
    if is_stopped or len(summaries) < len(requests):
        raise click.exceptions.Exit(INTERRUPTED)
    counts = sum((Counter(summary.counts) for summary in summaries), Counter[str]())
    not_done = counts["chosen_not_done"]
    if not_done:
        from pnpdepth_cli.commands.shared.tables import count_of

        raise FramesFailedError(
            f"{not_done:,} of {count_of(counts['chosen'], 'frame')} failed or diverged; the reasons"
            f" are in {values['output']}{'/*' if vary else ''}/summary.csv"
        )


def _request_of(values: dict[str, Any], folder: str, varied: dict[str, str]) -> BatchRequest:
    """Returns the request of a run, with the frames of a bag unpacked.

    Args:
        values: Values of all parameters of the command but `vary`; they are taken out of it.
        folder: Name of the run's own folder below the output and the report; empty without
            `--vary`, so that these folders themselves are its.
        varied: Values that `--vary` gives the run's options, as the user wrote them.
    """
    of_batch = options.take_options(BatchRequest, values)
    of_batch |= {name: values.pop(name) for name in ("source", "output")}
    request = BatchRequest(refine=options.request_of(values), varied=varied, **of_batch)
    if request.is_of_bag:
        # Imported where it is used: what writes frames takes 90 ms.
        from pnpdepth_cli.commands.frames import unpack

        request = unpack(request, say)
    html = None if request.html is None else request.html / folder
    return replace(request, output=request.output / folder, html=html)


def _run(
    request: BatchRequest, is_interrupted: Callable[[], bool], printed: set[str]
) -> tuple[BatchSummary, bool]:
    """Refines a batch and prints its summary; returns that, and whether a stop left frames to do.

    Args:
        request: The batch.
        is_interrupted: Function that is asked before each frame whether the batch is to stop.
        printed: Notes that are not printed again, as earlier batches of the command printed them;
            gets those of this batch. `--vary` makes several batches.
    """
    from pnpdepth_cli.cli.printing import print_batch
    from pnpdepth_cli.commands.batch import run_batch
    from pnpdepth_cli.commands.shared.tables import count_of

    def say_once(line: str) -> None:
        """Prints a note, unless this or an earlier batch of the command printed it."""
        if line not in printed:
            say_above_bar(line)
        printed.add(line)

    with progress_bar("batch", "frame") as show:
        listener = Listener(say_once, show, is_interrupted)
        summary = run_batch(request, listener)
    print_batch(summary, printed)
    if request.html is not None:
        say(f"wrote {request.html / 'index.html'}")
    is_stopped = listener.done < listener.to_do
    if is_stopped:
        count = f"{listener.done:,} of {count_of(listener.to_do, 'frame')}"
        say(f"stopped after {count}; run the same command to continue")
    return summary, is_stopped


@contextmanager
def _finishing_on_interrupt() -> Iterator[Callable[[], bool]]:
    """Yields a function that returns whether Ctrl-C was pressed; pressed again, it interrupts."""
    pressed = threading.Event()

    def handle(number: int, frame: FrameType | None) -> None:
        """Notes the first signal; the next one ends the command."""
        if pressed.is_set():
            raise KeyboardInterrupt
        pressed.set()
        # File descriptor 2 is stderr. Python's own stderr is buffered, and may be in use now. Where
        # it is closed, nobody reads the line.
        with suppress(OSError):
            os.write(2, _STOPPING)

    previous = signal.signal(signal.SIGINT, handle)
    try:
        yield pressed.is_set
    finally:
        signal.signal(signal.SIGINT, previous)


def _combinations(context: click.Context, varied: Sequence[str]) -> dict[str, _Combination]:
    """The combinations of the values of `--vary`, by the name of their folder.

    Without `--vary`, the one combination has no values and an empty name. Combinations that differ
    only in settings without effect are one.

    Args:
        context: Context of the command.
        varied: The text NAME=VALUE,VALUE,… of each `--vary`.

    Raises:
        UsageError: An option cannot be varied or refuses a value, an option or a value comes twice,
            a value is empty, or two combinations have one folder.
    """
    # The options, and the values of each.
    varying = [_option(context, text.partition("=")[0]) for text in varied]
    axes = [text.partition("=")[2].split(",") for text in varied]
    if any("" in axis for axis in axes):
        raise UsageError("--vary must be NAME=VALUE,VALUE with no value empty")
    if any(len({*axis}) < len(axis) for axis in axes) or len({*varying}) < len(varying):
        raise UsageError("--vary: an option or a value comes twice; leave one out")
    # Every value of each option with every value of the others.
    names = [option.opts[-1].removeprefix("--") for option in varying]
    combinations = dict[str, _Combination]()
    for words in itertools.product(*axes):
        texts = dict(zip(names, words, strict=True))
        # Without updates of z, the settings of updates have no effect and are left out.
        if texts.get("iterations") == "0":
            texts = {name: word for name, word in texts.items() if name not in OF_UPDATES}
        # The values as the command takes them. An option that is left out, or has the value
        # `default`, stays as it is without `--vary`.
        parameters = dict[str, object]()
        for name, option in zip(names, varying, strict=True):
            if texts.get(name, DEFAULT) != DEFAULT:
                value = (texts[name],) if option.multiple else texts[name]
                parameters[str(option.name)] = option.type_cast_value(context, value)
        combination = _Combination(texts, parameters)
        # The folder is named after the values; those that differ only in characters that names
        # cannot have would share it.
        folder = ",".join(f"{name}={_NOT_IN_NAMES.sub('-', word)}" for name, word in texts.items())
        if combinations.get(folder, combination) != combination:
            raise UsageError(f"--vary: two values have the folder {folder}; leave one out")
        combinations[folder] = combination
    return combinations


def _option(context: click.Context, name: str) -> click.Option:
    """The option that `--vary` calls by this name.

    Args:
        context: Context of the command.
        name: Long name of the option without its dashes, such as `lr`.

    Raises:
        UsageError: It cannot be varied, or is given besides.
    """
    command = context.command
    assert isinstance(command, options.GroupedCommand)
    flags = ["--sample", *(flag for group in _GROUPS for flag in command.groups[group])]
    if f"--{name}" not in flags:
        names = ", ".join(flag.removeprefix("--") for flag in flags)
        raise UsageError(f"--vary {name}: choose from {names}")
    option = next(parameter for parameter in command.params if parameter.opts[-1] == f"--{name}")
    assert isinstance(option, click.Option)
    if context.get_parameter_source(str(option.name)) is ParameterSource.COMMANDLINE:
        raise UsageError(f"--{name} is varied; leave it out besides")
    return option
