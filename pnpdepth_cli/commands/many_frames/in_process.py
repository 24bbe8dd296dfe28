"""Refines the frames of a batch in this process.

Threads read frames in advance, the network refines, and other threads write. The network runs only
in the calling thread, as it is patched while it is cut. The queues between the threads are bounded,
so memory does not grow with the number of frames.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field

from pnpdepth_cli.commands.many_frames.find_frames import request_of
from pnpdepth_cli.commands.many_frames.records import Records
from pnpdepth_cli.commands.refinement.requested import load_method, read_requested
from pnpdepth_cli.commands.refinement.write_refined import write_refined
from pnpdepth_cli.commands.requests.batch_request import BatchRequest
from pnpdepth_cli.commands.requests.refine_request import RefineRequest
from pnpdepth_cli.commands.shared.pipeline import THREADS, in_order, timed
from pnpdepth_cli.dataset.frame_as_read import ReadFrame
from pnpdepth_cli.dataset.frame_files import FrameFiles
from pnpdepth_cli.dataset.frame_record import BatchState, FrameRecord
from pnpdepth_cli.errors import InputError, ModelError, StorageError, UsageError
from pnpdepth_cli.frames.frame import Refined
from pnpdepth_cli.frames.method import Method


@contextmanager
def open_method(request: BatchRequest, deciding: Sequence[FrameFiles]) -> Iterator[Method | None]:
    """Yields the open method that refines all frames; None if none of `deciding` can be read.

    Args:
        request: The batch.
        deciding: A few frames of the batch, in order. What neither the user nor the network states,
            such as the layer, is found on the first that can be read. Two more help to find the
            range of the network's input. All of them tell how an image must be moved to fit its
            points.

    Raises:
        UsageError: The request combines what cannot be combined.
        ModelError: The network cannot be loaded.
    """
    frames = _readable(request, deciding)
    first = next(frames, None)
    if first is None:
        yield None
        return
    # Where a network states no input range, two more frames decide: of the middle and the end.
    others = deciding[1:]
    middle_and_end = sorted({len(others) // 2, len(others) - 1}) if others else []

    def read_more() -> list[ReadFrame]:
        """The two more frames, of which one or both may not be readable; read if needed."""
        return [*_readable(request, [others[place] for place in middle_and_end])]

    method = load_method(request.refine, first, read_more)
    # The images of one camera are moved alike, as all deciding frames that can be read tell.
    if first.register == "auto":
        method.share_registration(itertools.chain([first], frames))
    with method:
        yield method


def _readable(request: BatchRequest, frames: Iterable[FrameFiles]) -> Iterator[ReadFrame]:
    """Yields the frames that can be read; the others will have a record that says why not.

    Raises:
        UsageError: An option is wrong, which concerns all frames.
    """
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
    """What is asked of the frame."""
    seconds: dict[str, float] = field(default_factory=dict)
    """Seconds by the step that they were spent on."""
    state: BatchState | None = None
    """Its settings and files as they were when it was read. None: it was not."""
    frame: ReadFrame | None = None
    """What was read. None: an error ended it before."""
    refined: Refined | None = None
    """The result. None: an error ended it before, or it is not refined yet."""
    error: Exception | None = None
    """What ended it. None: nothing did so far."""

    @contextmanager
    def step(self, name: str) -> Iterator[None]:
        """Measures the time of the block, and keeps an exception in it as `error`.

        The exception goes no further, as it is this frame's alone.

        Args:
            name: What the time is spent on.
        """
        try:
            with timed(self.seconds, name):
                yield
        except Exception as error:
            self.error = error


@dataclass(frozen=True, kw_only=True)
class _Steps:
    """What is done with each frame: it is read, refined and written."""

    method: Method | None
    """None: no frame could be read when the batch began."""
    records: Records
    """Where the results and their records lie."""
    has_worked: bool
    """Whether a frame was refined with these settings before."""
    stopped: Callable[[], bool]
    """Function that is asked before each frame; True ends the batch."""

    def read(self, files: FrameFiles) -> _Work:
        """Returns a frame as it was read, or with the error that a file of it raised.

        Runs in one of the reading threads.
        """
        work = _Work(request=request_of(self.records.request, files))
        with work.step("read"):
            # First, so that a file that changes while it is read counts as changed in the next run.
            work.state = self.records.state(work.request)
            work.frame = read_requested(work.request)
        return work

    def refine(self, reading: Iterable[_Work]) -> Iterator[_Work]:
        """Yields each frame that was read, with its refined depth or its error.

        The calling thread runs it.

        Args:
            reading: The frames as `read` returns them, in order.

        Raises:
            StorageError: Nothing more can be written.
            ModelError, UsageError: An error of the network or the settings before any frame was
                refined, which may concern all frames.
        """
        # The network and the settings are proven once a frame was refined: then an error concerns
        # one frame alone. Without a method no frame can be refined, and each gets a record that
        # says so.
        is_proven = self.has_worked or self.method is None
        for work in reading:
            if self.stopped():
                return
            if work.frame is not None:
                with work.step("refine"):
                    if self.method is None:
                        raise InputError("no frame could be read when the batch began; try again")
                    # Ground truth scores the depth after each step as well.
                    with_stages = work.frame.gt is not None
                    work.refined = self.method.refine(work.frame, with_stages=with_stages)
            # An error that may concern all frames ends the batch; any other is this frame's.
            is_proven |= work.refined is not None
            of_all_frames: tuple[type[Exception], ...] = (StorageError,)
            if not is_proven:
                of_all_frames = (StorageError, ModelError, UsageError)
            if isinstance(work.error, of_all_frames):
                raise work.error
            yield work

    def write(self, work: _Work) -> FrameRecord:
        """Writes the result of a frame, or why there is none. Runs in one of the writing threads.

        Raises:
            StorageError: Nothing more can be written.
        """
        if work.refined is None or work.frame is None or self.method is None:
            return self.records.fail(work.request, work.error)
        try:
            return write_refined(
                work.request,
                self.records.outputs_of(work.request.files),
                self.method,
                work.frame,
                work.refined,
                work.seconds,
                batch=work.state,
                folder=self.records.request.output,
            )
        except StorageError:
            raise
        except Exception as error:  # concerns this frame only
            return self.records.fail(work.request, error)


def refine_frames(
    frames: Iterable[FrameFiles],
    method: Method | None,
    records: Records,
    has_worked: bool,
    stopped: Callable[[], bool] = lambda: False,
) -> Generator[FrameRecord, None, None]:
    """Refines and writes each frame; yields the record of each, in their order.

    An error is of its frame alone, unless nothing more can be written, or it is of the network or
    the settings before any frame was refined.

    Args:
        frames: The frames to refine.
        method: The method, open. None: no frame could be read when the batch began.
        records: Where the results and their records lie.
        has_worked: Whether a frame was refined with these settings before.
        stopped: Function that is asked before each frame; True ends the batch.

    Raises:
        StorageError, ModelError, UsageError: An error of all frames.
    """
    steps = _Steps(method=method, records=records, has_worked=has_worked, stopped=stopped)
    with (
        closing(in_order(steps.read, frames, THREADS)) as reading,
        closing(in_order(steps.write, steps.refine(reading), THREADS)) as done,
    ):
        yield from done
