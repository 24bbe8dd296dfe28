"""Frames read ahead, refined one after the other or a few together, and written behind.

The network runs in the thread that calls, and in no other: it is patched while it is cut. Readers
and writers are threads of their own, and queues between them are bounded, so memory does not grow
with the number of frames and the network waits for no file.
"""

from __future__ import annotations

import contextlib
import time
import traceback
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pnpdepth_cli.errors import (
    InputError,
    ModelError,
    PnpDepthError,
    StorageError,
    UsageError,
)
from pnpdepth_cli.io.fingerprint import Fingerprint
from pnpdepth_cli.pipeline.batch.frames import Task
from pnpdepth_cli.pipeline.batch.groups import FrameGroups
from pnpdepth_cli.pipeline.batch.profile import (
    NETWORK,
    READING,
    WAITING_TO_READ,
    WAITING_TO_WRITE,
    WRITING,
    BatchProfile,
)
from pnpdepth_cli.pipeline.batch.state import BatchState, known_inputs
from pnpdepth_cli.pipeline.batch.summary import failed_row, row_of
from pnpdepth_cli.pipeline.refinement.frame import RefinedFrame
from pnpdepth_cli.pipeline.refinement.inputs import Inputs, read_inputs
from pnpdepth_cli.pipeline.refinement.refine import Refiner, load_refiner, write_refined
from pnpdepth_cli.pipeline.stopwatch import Stopwatch

Row = dict[str, Any]


@dataclass(frozen=True, kw_only=True)
class ReadFrame:
    """A frame in memory, what its files were known by when it was read, and what reading took."""

    inputs: Inputs
    known: dict[str, Fingerprint]
    watch: Stopwatch


def settle_refiner(tasks: Iterable[Task], say: Callable[[str], None]) -> Refiner | None:
    """The network, with what it leaves open settled on the first frame that can be read.

    tasks: of all frames, also of those that are done or another shard's, so that every run decides
    the same. None if no frame can be read.
    """
    for task in tasks:
        try:
            first = read_inputs(task.request)
        except UsageError:
            raise
        except Exception:  # whatever it is, the frame will be read again, and its error told
            continue
        for note in first.notes:
            say(f"{task.name}: {note}")
        refiner = load_refiner(task.request, first)
        for note in refiner.network.notes:
            say(note)
        if task.request.hold_out.auto:
            return _with_ways(refiner, list(tasks), first, say)
        s = refiner.settings
        say(
            f"network: {refiner.network.definition.name} cut at {refiner.layer}, {s.iterations}"
            f" updates of z ({s.update}, {s.loss}, step {s.lr})"
        )
        return refiner
    return None


def _with_ways(
    refiner: Refiner, others: Sequence[Task], first: Inputs, say: Callable[[str], None]
) -> Refiner:
    """The refiner with the ways that are best on the first frame and on a few of the others."""
    frames = [first]
    for number in sorted({len(others) // 2, len(others) - 1}) if others else ():
        with contextlib.suppress(PnpDepthError):  # it will be read again, and its error told
            frames.append(read_inputs(others[number].request))
    refiner = refiner.with_ways_of(frames)
    assert refiner.ways is not None
    found = "; ".join(str(way) for way in refiner.ways)
    say(f"auto: best on {len(frames)} frames, and to be checked on each: {found}")
    return refiner


def run_tasks(
    tasks: Iterable[Task],
    refiner: Refiner | None,
    state: BatchState,
    *,
    workers: int,
    batch_size: int | None,
    proven: bool,
    stopped: Callable[[], bool],
    say: Callable[[str], None],
    profile: BatchProfile,
) -> Generator[Row, None, None]:
    """Each task is done and recorded; a row for each, in their order.

    A frame that cannot be done has a row that says why. batch_size: see `FrameGroups`. proven: some
    frame went through with these settings before. stopped(): no further frame is begun. Raises
    StorageError when nothing more can be written, and an error of network or settings that shows
    before any frame went through.
    """
    writing: deque[Future[Row]] = deque()

    def written() -> Row:
        with profile(WAITING_TO_WRITE):
            return writing.popleft().result()

    with (
        profile.wall(),
        refiner.split() if refiner is not None else nullcontext() as split,
        ThreadPoolExecutor(workers) as readers,
        ThreadPoolExecutor(workers) as writers,
    ):
        groups = None
        if refiner is not None and split is not None:
            groups = FrameGroups(refiner, split, batch_size, say)
        reading = _read_ahead(tasks, readers, workers, groups, profile)
        try:
            for group in _gathered(reading, groups, profile):
                if stopped():
                    break
                for task, read, made in _refined(groups, group, profile):
                    if isinstance(made, Exception):
                        if not proven and isinstance(made, ModelError | UsageError):
                            raise made
                        writing.append(writers.submit(_failed, state, task, made))
                    else:
                        proven = True
                        assert read is not None
                        assert refiner is not None
                        given = (state, task, read, refiner, made, profile)
                        writing.append(writers.submit(_write, *given))
                # What is refined but not written is lost if the process is killed; so it is little.
                while writing and (writing[0].done() or len(writing) >= workers + len(group)):
                    yield written()
            while writing:
                yield written()
        finally:
            reading.close()
            for future in writing:  # after a full disk they would only fail as well
                future.cancel()


def _read_ahead(
    tasks: Iterable[Task],
    readers: ThreadPoolExecutor,
    workers: int,
    groups: FrameGroups | None,
    profile: BatchProfile,
) -> Generator[tuple[Task, Future[ReadFrame]], None, None]:
    waiting: deque[tuple[Task, Future[ReadFrame]]] = deque()
    try:
        for task in tasks:
            waiting.append((task, readers.submit(_read, task, profile)))
            if len(waiting) > 2 * workers + (groups.largest - 1 if groups else 0):
                yield waiting.popleft()
        while waiting:
            yield waiting.popleft()
    finally:
        for _, future in waiting:
            future.cancel()


def _gathered(
    reading: Iterable[tuple[Task, Future[ReadFrame]]],
    groups: FrameGroups | None,
    profile: BatchProfile,
) -> Generator[list[tuple[Task, ReadFrame | Exception]], None, None]:
    """The frames in their order, so many of one size at once as go together.

    One that could not be read is passed on in its place, and counts for nothing.
    """
    group: list[tuple[Task, ReadFrame | Exception]] = []
    size: tuple[int, int] | None = None
    for task, future in reading:
        with profile(WAITING_TO_READ):
            read = _outcome(future)
        if isinstance(read, ReadFrame):
            if size not in (None, read.inputs.size):
                yield group
                group = []
            size = read.inputs.size
        group.append((task, read))
        wanted = 1 if size is None or groups is None else groups.of_size(size)
        if sum(isinstance(read, ReadFrame) for _, read in group) >= wanted or size is None:
            yield group
            group, size = [], None
    if group:
        yield group


def _outcome(future: Future[ReadFrame]) -> ReadFrame | Exception:
    try:
        return future.result()
    except Exception as error:  # this frame's own matter
        return error


def _refined(
    groups: FrameGroups | None,
    group: Sequence[tuple[Task, ReadFrame | Exception]],
    profile: BatchProfile,
) -> Iterator[tuple[Task, ReadFrame | None, RefinedFrame | Exception]]:
    """Each frame with what was read and what was made of it; or None, and why it was not read."""
    frames = [read for _, read in group if isinstance(read, ReadFrame)]
    results: list[RefinedFrame | Exception] = []
    if groups is None:
        missing = InputError("no frame could be read when the batch began; run it again")
        results = [missing for _ in frames]
    elif frames:
        with profile(NETWORK):
            start = time.perf_counter()
            results = groups.refine([frame.inputs for frame in frames])
            for frame in frames:
                frame.watch.add("refine", (time.perf_counter() - start) / len(frames))
            groups.try_out()
    made = iter(results)
    for task, read in group:
        if isinstance(read, ReadFrame):
            yield task, read, next(made)
        else:
            yield task, None, read


def _read(task: Task, profile: BatchProfile) -> ReadFrame:
    watch = Stopwatch()
    with watch("read"), profile(READING):
        known = known_inputs(task)
        inputs = read_inputs(task.request)
    return ReadFrame(inputs=inputs, known=known, watch=watch)


def _write(
    state: BatchState,
    task: Task,
    read: ReadFrame,
    refiner: Refiner,
    frame: RefinedFrame,
    profile: BatchProfile,
) -> Row:
    try:
        with profile(WRITING):
            state.begin(task)
            outcome = write_refined(task.outputs, refiner, read.inputs, frame, read.watch)
            written = {
                kind: path.relative_to(state.output).as_posix()
                for kind, path in task.outputs.by_kind().items()
            }
            row = row_of(task.name, _paths(task), outcome.record, written)
            state.finish(task, "diverged" if outcome.diverged else "done", row, read.known)
    except StorageError:
        raise
    except Exception as error:
        return _failed(state, task, error)
    profile.count()
    return row


def _failed(state: BatchState, task: Task, error: Exception) -> Row:
    row = failed_row(task.name, _paths(task), _message(error))
    state.fail(task, row)
    return row


def _paths(task: Task) -> dict[str, str]:
    return {part: str(path) for part, path in task.inputs.items()}


def _message(error: Exception) -> str:
    if isinstance(error, PnpDepthError):
        return str(error)
    place = traceback.extract_tb(error.__traceback__)[-1]
    return (
        f"a bug of pnpdepth: {type(error).__name__}: {error} ({Path(place.filename).name}, line"
        f" {place.lineno})"
    )
