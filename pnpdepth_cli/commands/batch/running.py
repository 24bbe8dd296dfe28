"""Refines frames: threads read them in advance, the network refines, other threads write.

The network runs only in the calling thread, as it is patched while it is cut. The queues between
the threads are bounded, so memory does not grow with the number of frames.
"""

from __future__ import annotations

import functools
import traceback
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple, TypeVar

from pnpdepth_cli.commands.batch.batch_request import BatchRequest
from pnpdepth_cli.commands.batch.find_frames import Task, task_of
from pnpdepth_cli.commands.batch.records import Records
from pnpdepth_cli.commands.ordered_pool import THREADS, in_order
from pnpdepth_cli.commands.refinement.refine_image import load_method, read_requested, write_refined
from pnpdepth_cli.commands.stopwatch import Stopwatch
from pnpdepth_cli.dataset.frame_files import FrameFiles
from pnpdepth_cli.dataset.frame_record import FrameRecord
from pnpdepth_cli.errors import (
    InputError,
    ModelError,
    PnpDepthError,
    StorageError,
    UsageError,
)
from pnpdepth_cli.frames.frame import Frame
from pnpdepth_cli.frames.method import Method
from pnpdepth_cli.frames.refined import Refined
from pnpdepth_cli.io.file_bytes import Fingerprint, fingerprint

Item = TypeVar("Item")
REGISTERING = 16
"""Number of frames that decide together how images are moved to the points."""


def read_task(task: Task, known: dict[str, Fingerprint] | None = None) -> Frame:
    """Returns the contents of a frame's files.

    Args:
        task: The frame.
        known: Gets the fingerprints of the files, by part.

    Raises:
        PnpDepthError: The errors of `read_frame`.
    """
    if known is not None:
        known |= {part: fingerprint(path) for part, path in task.inputs.items()}
    return read_requested(task.request)


class References(NamedTuple):
    """The frames that decide for all frames of a batch."""

    first: FrameFiles
    """The first one that can be read."""
    others: Sequence[FrameFiles]
    """More frames, for input ranges where the network states none."""
    registering: Sequence[FrameFiles]
    """Frames that decide how images are moved to the points."""


def references_of(request: BatchRequest, frames: Sequence[FrameFiles]) -> References | None:
    """Returns the frames that decide, of all frames, so that every run and shard decides the same.

    Returns:
        None if no frame can be read.
    """
    for number, frame in enumerate(frames):
        if _readable(task_of(request, frame)) is not None:
            others = reference_frames(frames, number)
            return References(frame, others, registering(frames, number))
    return None


def reference_frames(frames: Sequence[Item], first: int) -> list[Item]:
    """Returns the frames behind the first readable one that decide input ranges with it."""
    count = len(frames) - first - 1
    return [frames[first + 1 + i] for i in sorted({count // 2, count - 1})] if count else []


def registering(frames: Sequence[Item], first: int) -> list[Item]:
    """Returns the frames, the first readable one among them, that decide the registration."""
    count = len(frames) - first
    chosen = {first + i * (count - 1) // (REGISTERING - 1) for i in range(REGISTERING)}
    return [frames[i] for i in sorted(chosen)]


@contextmanager
def open_method(
    request: BatchRequest, references: References, say: Callable[[str], None]
) -> Iterator[Method]:
    """Yields the network, resolved on the frames that decide, open for any number of frames.

    Args:
        request: The batch.
        references: Frames that decide, from `references_of`.
        say: Receives what was decided.
    """
    # The first frame that can be read.
    task = task_of(request, references.first)
    first = read_task(task)
    for note in first.notes:
        say(f"{task.name}: {note}")

    # The method, resolved on it and on others, if need be.
    def readable(frames: Iterable[FrameFiles]) -> Iterator[Frame]:
        read = (_readable(task_of(request, frame)) for frame in frames)
        return (frame for frame in read if frame is not None)

    others = functools.cache(lambda: [*readable(references.others)])
    method = load_method(task.request, first, others)
    for note in method.network.notes:
        say(note)
    # The registration that all images share.
    if first.register == "auto":
        method.share_registration(readable(references.registering))
        for (height, width), registration in method.registrations.items():
            if registration is not None:
                say(
                    f"images of {width}×{height} are moved to the points by"
                    f" {registration}; --registration off leaves them"
                )
    # What refines, for a person.
    if method.is_default:
        names = " and ".join(member.network.definition.name for member in method.members)
        say(f"method: the default, with {names}")
    else:
        s = method.settings
        say(
            f"network: {method.network.definition.name} cut at {method.own.layer}, {s.iterations}"
            f" updates of z ({s.update}, {s.loss}, step {s.lr})"
        )
    with method:
        yield method


def _readable(task: Task) -> Frame | None:
    """The frame's contents; None if it cannot be read, which is reported later.

    UsageError if an option is wrong, for all frames.
    """
    try:
        return read_task(task)
    except UsageError:
        raise
    except Exception:
        return None


@dataclass(kw_only=True)
class FrameInMemory:
    """A frame on its way through the network."""

    task: Task
    inputs: Frame | None = None
    fingerprints: dict[str, Fingerprint] = field(default_factory=dict)
    watch: Stopwatch = field(default_factory=Stopwatch)
    result: Refined | Exception | None = None
    """An error that occurred while it was read or refined. None before."""


def refine_tasks(
    tasks: Iterable[Task],
    method: Method,
    records: Records,
    *,
    settings_worked: bool,
    stopped: Callable[[], bool] = lambda: False,
) -> Generator[FrameRecord, None, None]:
    """Refines and writes each task; yields the record of each, in their order.

    Args:
        tasks: The frames to refine.
        method: The method, open.
        records: Writes the results.
        settings_worked: True if a frame was refined with these settings before.
        stopped: True if no further frame is to be begun.

    Raises:
        StorageError: When nothing more can be written.
        ModelError: For an error of the network before any frame was refined.
        UsageError: For an error of the settings before any frame was refined.
    """

    def refine(reading: Iterable[FrameInMemory]) -> Iterator[FrameInMemory]:
        worked = settings_worked
        for frame in reading:
            if stopped():
                return
            _refine(frame, method)
            worked |= isinstance(frame.result, Refined)
            fatal = StorageError if worked else (StorageError, ModelError, UsageError)
            if isinstance(frame.result, fatal):
                raise frame.result
            yield frame

    def write(frame: FrameInMemory) -> FrameRecord:
        return _write(frame, method, records)

    with (
        closing(in_order(_read, tasks, THREADS)) as reading,
        closing(in_order(write, refine(reading), THREADS)) as done,
    ):
        yield from done


def fail_unreadable(tasks: Iterable[Task], records: Records) -> Iterator[FrameRecord]:
    """Writes for each task why it cannot be read; yields the records."""
    for task in tasks:
        result = _read(task).result
        later = InputError("no frame could be read when the batch began; run it again")
        yield records.fail(task, _message(result if isinstance(result, Exception) else later))


def _refine(frame: FrameInMemory, method: Method) -> None:
    """Sets the result of a frame that was read."""
    if frame.inputs is None:
        return
    with frame.watch("refine"):
        try:
            frame.result = method.refine(frame.inputs)
        except Exception as error:  # concerns this frame only
            frame.result = error


def _read(task: Task) -> FrameInMemory:
    frame = FrameInMemory(task=task)
    try:
        with frame.watch("read"):
            frame.inputs = read_task(task, frame.fingerprints)
    except Exception as error:  # concerns this frame only
        frame.result = error
    return frame


def _write(frame: FrameInMemory, method: Method, records: Records) -> FrameRecord:
    """Writes a frame's results, or why there are none; returns the record."""
    inputs, result = frame.inputs, frame.result
    if isinstance(result, Refined) and inputs is not None:
        refined = result
        try:
            return records.write(
                frame.task,
                frame.fingerprints,
                lambda outputs: write_refined(
                    frame.task.request, outputs, method, inputs, refined, frame.watch
                ),
            )
        except StorageError:
            raise
        except Exception as error:
            result = error
    assert isinstance(result, Exception)
    return records.fail(frame.task, _message(result))


def _message(error: Exception) -> str:
    if isinstance(error, PnpDepthError):
        return str(error)
    line = traceback.extract_tb(error.__traceback__)[-1]
    return (
        f"a bug of pnpdepth: {type(error).__name__}: {error} ({Path(line.filename).name}, line"
        f" {line.lineno})"
    )
