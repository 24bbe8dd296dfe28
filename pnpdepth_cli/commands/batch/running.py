"""Refines frames: threads read them in advance, the network refines, other threads write.

The network runs only in the calling thread, as it is patched while it is cut. The queues between
the threads are bounded, so memory does not grow with the number of frames.
"""

from __future__ import annotations

import itertools
import traceback
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
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


def spread(count: int) -> list[int]:
    """Returns at most `DECIDING` numbers from 0 to count - 1, with both among them."""
    return sorted({i * (count - 1) // (DECIDING - 1) for i in range(DECIDING)})


@contextmanager
def open_method(request: BatchRequest, deciding: Sequence[FrameFiles]) -> Iterator[Method | None]:
    """Yields the method, open for any number of frames; None if no frame can be read.

    Args:
        request: The batch.
        deciding: The frames that decide what is open for all.
    """
    frames = _readable(request, deciding)
    first = next(frames, None)
    if first is None:
        yield None
        return
    # Where a network states no input range, two others decide as well.
    behind = deciding[1:]
    two = [behind[i] for i in sorted({len(behind) // 2, len(behind) - 1})] if behind else []
    method = load_method(request.refine, first, lambda: [*_readable(request, two)])
    # The images share a registration.
    if first.register == "auto":
        method.share_registration(itertools.chain([first], frames))
    with method:
        yield method


def _readable(request: BatchRequest, frames: Iterable[FrameFiles]) -> Iterator[Frame]:
    """The contents of the frames that can be read. UsageError if an option is wrong, for all."""
    for files in frames:
        try:
            yield read_requested(request_of(request, files))
        except UsageError:
            raise
        except Exception:  # concerns this frame only, whose record will say so
            continue


@dataclass(kw_only=True)
class _Work:
    """A frame on its way: what was read and refined, or the error that ended it."""

    request: RefineRequest
    watch: Stopwatch = field(default_factory=Stopwatch)
    inputs: dict[str, Fingerprint] = field(default_factory=dict)
    frame: Frame | None = None
    refined: Refined | None = None
    error: Exception | None = None

    @contextmanager
    def step(self, name: str) -> Iterator[None]:
        """Measures the time of the block; an error in it is this frame's alone, and kept."""
        try:
            with self.watch(name):
                yield
        except Exception as error:
            self.error = error


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

    def read(files: FrameFiles) -> _Work:
        work = _Work(request=request_of(records.request, files))
        with work.step("read"):
            parts = input_files(work.request)
            work.inputs |= {part: fingerprint(path) for part, path in parts}
            work.frame = read_requested(work.request)
        return work

    def refine(reading: Iterable[_Work]) -> Iterator[_Work]:
        worked = settings_worked or method is None
        for work in reading:
            if stopped():
                return
            if work.frame is not None:
                with work.step("refine"):
                    if method is None:
                        raise InputError("no frame could be read when the batch began; try again")
                    work.refined = method.refine(work.frame)
            worked |= work.refined is not None
            fatal = StorageError if worked else (StorageError, ModelError, UsageError)
            if isinstance(work.error, fatal):
                raise work.error
            yield work

    def write(work: _Work) -> FrameRecord:
        return _write(work, method, records)

    with (
        closing(in_order(read, frames, THREADS)) as reading,
        closing(in_order(write, refine(reading), THREADS)) as done,
    ):
        yield from done


def _write(work: _Work, method: Method | None, records: Records) -> FrameRecord:
    """Writes a frame's results, or why there are none; returns the record."""
    request, error = work.request, work.error
    if work.refined is not None and work.frame is not None and method is not None:
        try:
            return write_refined(
                request, records.outputs_of(request.files), method, work.frame, work.refined,
                work.watch, batch=records.state(request, work.inputs),
                folder=records.request.output,
            )  # fmt: skip
        except StorageError:
            raise
        except Exception as failure:
            error = failure
    return records.fail(request, _message(error))


def _message(error: Exception | None) -> str:
    if error is None or isinstance(error, PnpDepthError):
        return str(error)
    line = traceback.extract_tb(error.__traceback__)[-1]
    return (
        f"a bug of pnpdepth: {type(error).__name__}: {error} ({Path(line.filename).name}, line"
        f" {line.lineno})"
    )
