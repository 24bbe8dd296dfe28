"""Runs a batch: threads read frames in advance, the network refines, other threads write.

The network runs only in the calling thread, as it is patched while it is cut. The queues between
the threads are bounded, so memory does not grow with the number of frames.
"""

from __future__ import annotations

import time
import traceback
from collections import deque
from collections.abc import Generator, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from pnpdepth_cli.errors import (
    InputError,
    ModelError,
    PnpDepthError,
    StorageError,
    UsageError,
)
from pnpdepth_cli.frames.frame import RefinedFrame
from pnpdepth_cli.io.fingerprint import Fingerprint
from pnpdepth_cli.pipeline.batch.frames import Task
from pnpdepth_cli.pipeline.batch.groups import FrameGroups
from pnpdepth_cli.pipeline.batch.output_folder import published, staged
from pnpdepth_cli.pipeline.batch.profile import (
    NETWORK,
    READING,
    WAITING_TO_READ,
    WAITING_TO_WRITE,
    WRITING,
    BatchProfile,
)
from pnpdepth_cli.pipeline.batch.reading import read_task
from pnpdepth_cli.pipeline.batch.run import BatchRun
from pnpdepth_cli.pipeline.batch.state import Fingerprints, FrameRecorder, Status
from pnpdepth_cli.pipeline.batch.summary import failed_row, row_of
from pnpdepth_cli.pipeline.refinement.inputs import Inputs
from pnpdepth_cli.pipeline.refinement.refine import write_refined
from pnpdepth_cli.pipeline.refinement.refiner import Refiner
from pnpdepth_cli.pipeline.stopwatch import Stopwatch

Row = dict[str, Any]


@dataclass(frozen=True, kw_only=True)
class ReadFrame:
    """A frame in memory."""

    inputs: Inputs
    """Its contents."""
    fingerprints: dict[str, Fingerprint]
    """Of its files when they were read, by part."""
    watch: Stopwatch
    """With the seconds of reading."""


def run_tasks(
    tasks: Iterable[Task], groups: FrameGroups | None, run: BatchRun, *, proven: bool
) -> Generator[Row, None, None]:
    """Refines and records each task; yields a row for each, in their order.

    Args:
        tasks: The frames to refine.
        groups: The network, open; None if no frame could be read.
        run: What the frames share.
        proven: True if a frame was refined with these settings before.

    Raises:
        StorageError: When nothing more can be written.
        ModelError: For an error of the network before any frame was refined.
        UsageError: For an error of the settings before any frame was refined.
    """
    with closing(run_arriving(tasks, groups, run, proven=proven)) as rows:
        yield from (row for row in rows if row is not None)


def run_arriving(
    tasks: Iterable[Task | None], groups: FrameGroups | None, run: BatchRun, *, proven: bool
) -> Generator[Row | None, None, None]:
    """Does what `run_tasks` does, with tasks that arrive in the meantime.

    A None among the tasks says that the next one has not arrived. It yields None, so that the
    caller can fetch more; threads go on reading and writing the frames before it.
    """
    profile, workers = run.profile, run.workers
    writing: deque[Future[Row]] = deque()

    def written() -> Row:
        with profile(WAITING_TO_WRITE):
            return writing.popleft().result()

    with (
        profile.wall(),
        ThreadPoolExecutor(workers) as readers,
        ThreadPoolExecutor(workers) as writers,
    ):
        reading = _read_ahead(tasks, readers, workers, groups, profile)
        try:
            for group in _gathered(reading, groups, profile):
                if run.stopped():
                    break
                if group is None:
                    yield None
                    continue
                for task, read, result in _refined(groups, group, profile):
                    if not task.written:
                        continue
                    if isinstance(result, Exception):
                        of_all = not proven and isinstance(result, ModelError | UsageError)
                        if of_all or isinstance(result, StorageError):
                            raise result
                        writing.append(writers.submit(_failed, run.state, task, result))
                    else:
                        proven = True
                        assert read is not None
                        assert groups is not None
                        arguments = (run, task, read, groups.refiner, result)
                        writing.append(writers.submit(_write, *arguments))
                # frames not yet written are lost if the process is killed, so there are few
                while writing and (writing[0].done() or len(writing) >= workers + len(group)):
                    yield written()
            while writing:
                yield written()
        finally:
            reading.close()
            for future in writing:  # after a full disk they would fail too
                future.cancel()


def _read_ahead(
    tasks: Iterable[Task | None],
    readers: ThreadPoolExecutor,
    workers: int,
    groups: FrameGroups | None,
    profile: BatchProfile,
) -> Generator[tuple[Task, Future[ReadFrame]] | None, None, None]:
    waiting: deque[tuple[Task, Future[ReadFrame]]] = deque()
    try:
        for task in tasks:
            if task is None:
                yield None
                continue
            waiting.append((task, readers.submit(_read, task, profile)))
            if len(waiting) > 2 * workers + (groups.largest - 1 if groups else 0):
                yield waiting.popleft()
        while waiting:
            yield waiting.popleft()
    finally:
        for _, future in waiting:
            future.cancel()


def _gathered(
    reading: Iterable[tuple[Task, Future[ReadFrame]] | None],
    groups: FrameGroups | None,
    profile: BatchProfile,
) -> Generator[list[tuple[Task, ReadFrame | Exception]] | None, None, None]:
    """The frames in their order, in groups of one size that go together.

    One that could not be read keeps its position and does not count. A None stays one.
    """
    group: list[tuple[Task, ReadFrame | Exception]] = []
    size: tuple[int, int] | None = None
    for each in reading:
        if each is None:
            yield None
            continue
        task, future = each
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
    """Each frame with its inputs and its result or error; or None, and why it was not read."""
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
    of_frames = iter(results)
    for task, read in group:
        if isinstance(read, ReadFrame):
            yield task, read, next(of_frames)
        else:
            yield task, None, read


def _read(task: Task, profile: BatchProfile) -> ReadFrame:
    watch = Stopwatch()
    with watch("read"), profile(READING):
        inputs, fingerprints = read_task(task)
    return ReadFrame(inputs=inputs, fingerprints=fingerprints, watch=watch)


def _write(
    run: BatchRun, task: Task, read: ReadFrame, refiner: Refiner, frame: RefinedFrame
) -> Row:
    state = run.state
    try:
        with run.profile(WRITING), staged(task.outputs, state.output) as stage:
            state.begin(task)
            outcome = write_refined(stage, refiner, read.inputs, frame, read.watch)
            outputs, known = published(outcome.outputs, task.outputs, stage, state.output)
            task = replace(task, outputs=outputs)
            written = {
                kind: path.relative_to(state.output).as_posix()
                for kind, path in task.outputs.by_kind().items()
            }
            row = row_of(task.name, _paths(task), outcome.record, written)
            status: Status = "diverged" if outcome.diverged else "done"
            state.finish(task, status, row, Fingerprints(read=read.fingerprints, written=known))
    except StorageError:
        raise
    except Exception as error:
        return _failed(state, task, error)
    run.profile.count()
    return row


def _failed(state: FrameRecorder, task: Task, error: Exception) -> Row:
    row = failed_row(task.name, _paths(task), _message(error))
    state.fail(task, row)
    return row


def _paths(task: Task) -> dict[str, str]:
    return {part: str(path) for part, path in task.inputs.items()}


def _message(error: Exception) -> str:
    if isinstance(error, PnpDepthError):
        return str(error)
    line = traceback.extract_tb(error.__traceback__)[-1]
    return (
        f"a bug of pnpdepth: {type(error).__name__}: {error} ({Path(line.filename).name}, line"
        f" {line.lineno})"
    )
