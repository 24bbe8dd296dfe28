"""Refines frames: threads read them in advance, the network refines, other threads write.

The network runs only in the calling thread, as it is patched while it is cut. The queues between
the threads are bounded, so memory does not grow with the number of frames.
"""

from __future__ import annotations

import functools
import traceback
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path

from pnpdepth_cli.commands.batch.batch_request import BatchRequest
from pnpdepth_cli.commands.batch.find_frames import input_files, request_of
from pnpdepth_cli.commands.batch.records import Records
from pnpdepth_cli.commands.ordered_pool import THREADS, in_order
from pnpdepth_cli.commands.refinement.refine_image import load_method, read_requested, write_refined
from pnpdepth_cli.commands.refinement.refine_request import RefineRequest
from pnpdepth_cli.commands.stopwatch import Stopwatch
from pnpdepth_cli.dataset.frame_files import FrameFiles
from pnpdepth_cli.dataset.frame_record import FrameRecord
from pnpdepth_cli.errors import InputError, ModelError, PnpDepthError, StorageError, UsageError
from pnpdepth_cli.frames.frame import Frame
from pnpdepth_cli.frames.method import Method
from pnpdepth_cli.frames.refined import Refined
from pnpdepth_cli.io.file_bytes import Fingerprint, fingerprint

DECIDING = 16
"""Number of frames that decide together how images are moved to the points."""


def deciding_frames(request: BatchRequest, frames: Sequence[FrameFiles]) -> list[FrameFiles]:
    """Returns the frames that decide for all, so that every run and shard decides the same.

    They are spread from the first one that can be read to the last. None can be read: none.
    """
    readable = (n for n, frame in enumerate(frames) if _readable(request, frame) is not None)
    first = next(readable, None)
    if first is None:
        return []
    return [frames[first + number] for number in spread(len(frames) - first)]


def spread(count: int) -> list[int]:
    """Returns at most `DECIDING` numbers from 0 to count - 1, with both among them."""
    return sorted({i * (count - 1) // (DECIDING - 1) for i in range(DECIDING)})


@contextmanager
def open_method(
    request: BatchRequest,
    deciding: Sequence[FrameFiles],
    shown: FrameFiles,
    say: Callable[[str], None],
) -> Iterator[Method | None]:
    """Yields the method, resolved on the frames that decide, open for any number of frames.

    Args:
        request: The batch.
        deciding: The frames of `deciding_frames`. Without any, there is no method.
        shown: The frame whose notes are said, the first that is to be refined.
        say: Receives what was decided.
    """
    if not deciding:
        yield None
        return
    # The first frame.
    first_request = request_of(request, deciding[0])
    first = read_requested(first_request)
    to_show = first if shown.name == deciding[0].name else _readable(request, shown)
    for note in () if to_show is None else to_show.notes:
        say(f"{shown.name}: {note}")

    # The method, resolved on it and, where a network states no input range, on two others.
    def readable(frames: Iterable[FrameFiles]) -> Iterator[Frame]:
        read = (_readable(request, frame) for frame in frames)
        return (frame for frame in read if frame is not None)

    behind = deciding[1:]
    two = [behind[i] for i in sorted({len(behind) // 2, len(behind) - 1})] if behind else []
    others = functools.cache(lambda: [*readable(two)])
    method = load_method(first_request, first, others)
    for note in method.network.notes:
        say(note)
    # The registration that all images share.
    if first.register == "auto":
        method.share_registration(readable(deciding))
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


def _readable(request: BatchRequest, frame: FrameFiles) -> Frame | None:
    """The frame's contents; None if it cannot be read, which is reported later.

    UsageError if an option is wrong, for all frames.
    """
    try:
        return read_requested(request_of(request, frame))
    except UsageError:
        raise
    except Exception:
        return None


@dataclass(frozen=True, kw_only=True)
class ReadFrame:
    """A frame that was read, or the error that occurred."""

    request: RefineRequest
    frame: Frame | Exception
    inputs: dict[str, Fingerprint]
    watch: Stopwatch


def refine_frames(
    frames: Iterable[FrameFiles],
    method: Method | None,
    records: Records,
    *,
    settings_worked: bool,
    stopped: Callable[[], bool] = lambda: False,
) -> Generator[FrameRecord, None, None]:
    """Refines and writes each frame; yields the record of each, in their order.

    Args:
        frames: The frames to refine.
        method: The method, open. None if no frame of the batch could be read.
        records: The results.
        settings_worked: True if a frame was refined with these settings before.
        stopped: True if no further frame is to be begun.

    Raises:
        StorageError: When nothing more can be written.
        ModelError: For an error of the network before any frame was refined.
        UsageError: For an error of the settings before any frame was refined.
    """

    def refine(reading: Iterable[ReadFrame]) -> Iterator[tuple[ReadFrame, Refined | Exception]]:
        worked = settings_worked or method is None
        for read in reading:
            if stopped():
                return
            result = _refine(read, method)
            worked |= isinstance(result, Refined)
            fatal = StorageError if worked else (StorageError, ModelError, UsageError)
            if isinstance(result, fatal):
                raise result
            yield read, result

    def write(frame: tuple[ReadFrame, Refined | Exception]) -> FrameRecord:
        return _write(*frame, method, records)

    with (
        closing(in_order(functools.partial(_read, records), frames, THREADS)) as reading,
        closing(in_order(write, refine(reading), THREADS)) as done,
    ):
        yield from done


def _read(records: Records, files: FrameFiles) -> ReadFrame:
    request, watch = request_of(records.request, files), Stopwatch()
    inputs: dict[str, Fingerprint] = {}
    frame: Frame | Exception
    try:
        with watch("read"):
            inputs |= {part: fingerprint(path) for part, path in input_files(request)}
            frame = read_requested(request)
    except Exception as error:  # concerns this frame only
        frame = error
    return ReadFrame(request=request, frame=frame, inputs=inputs, watch=watch)


def _refine(read: ReadFrame, method: Method | None) -> Refined | Exception:
    if isinstance(read.frame, Exception):
        return read.frame
    if method is None:
        return InputError("no frame could be read when the batch began; run it again")
    with read.watch("refine"):
        try:
            return method.refine(read.frame)
        except Exception as error:  # concerns this frame only
            return error


def _write(
    read: ReadFrame, result: Refined | Exception, method: Method | None, records: Records
) -> FrameRecord:
    """Writes a frame's results, or why there are none; returns the record."""
    request, frame = read.request, read.frame
    if isinstance(result, Refined) and isinstance(frame, Frame) and method is not None:
        try:
            return write_refined(
                request, records.outputs_of(request.files), method, frame, result, read.watch,
                batch=records.state(request, read.inputs), folder=records.request.output,
            )  # fmt: skip
        except StorageError:
            raise
        except Exception as error:
            result = error
    assert isinstance(result, Exception)
    return records.fail(request, _message(result))


def _message(error: Exception) -> str:
    if isinstance(error, PnpDepthError):
        return str(error)
    line = traceback.extract_tb(error.__traceback__)[-1]
    return (
        f"a bug of pnpdepth: {type(error).__name__}: {error} ({Path(line.filename).name}, line"
        f" {line.lineno})"
    )
