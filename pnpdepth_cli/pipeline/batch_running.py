"""Frames read ahead, refined one after the other, and written behind.

The network runs in the thread that calls, and in no other: it is patched while it is cut. Readers
and writers are threads of their own, and queues between them are bounded, so memory does not grow
with the number of frames and the network waits for no file.
"""

from __future__ import annotations

import traceback
from collections import deque
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
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
from pnpdepth_cli.pipeline.batch_frames import Task
from pnpdepth_cli.pipeline.batch_state import BatchState, known_inputs
from pnpdepth_cli.pipeline.batch_summary import failed_row, row_of
from pnpdepth_cli.pipeline.frame import RefinedFrame
from pnpdepth_cli.pipeline.inputs import Inputs, read_inputs
from pnpdepth_cli.pipeline.refine import Refiner, load_refiner, write_refined
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
        s = refiner.settings
        say(
            f"network: {refiner.network.definition.name} cut at {refiner.layer}, {s.iterations}"
            f" updates of z ({s.update}, {s.loss}, step {s.lr})"
        )
        return refiner
    return None


def run_tasks(
    tasks: Iterable[Task],
    refiner: Refiner | None,
    state: BatchState,
    *,
    workers: int,
    proven: bool,
    stopped: Callable[[], bool],
) -> Generator[Row, None, None]:
    """Each task is done and recorded; a row for each, in their order.

    A frame that cannot be done has a row that says why. proven: some frame went through with these
    settings before. stopped(): no further frame is begun. Raises StorageError when nothing more can
    be written, and an error of network or settings that shows before any frame went through.
    """
    writing: deque[Future[Row]] = deque()
    with ThreadPoolExecutor(workers) as readers, ThreadPoolExecutor(workers) as writers:
        reading = _read_ahead(tasks, readers, 2 * workers)
        try:
            for task, read in reading:
                if stopped():
                    break
                try:
                    done = _read_and_refined(refiner, read)
                except Exception as error:
                    if not proven and isinstance(error, ModelError | UsageError):
                        raise
                    writing.append(writers.submit(_failed, state, task, error))
                else:
                    proven = True
                    writing.append(writers.submit(_write, state, task, *done))
                # What is refined but not written is lost if the process is killed; so it is little.
                while writing and (writing[0].done() or len(writing) > workers):
                    yield writing.popleft().result()
            while writing:
                yield writing.popleft().result()
        finally:
            reading.close()
            for future in writing:  # after a full disk they would only fail as well
                future.cancel()


def _read_ahead(
    tasks: Iterable[Task], readers: ThreadPoolExecutor, ahead: int
) -> Generator[tuple[Task, Future[ReadFrame]], None, None]:
    waiting: deque[tuple[Task, Future[ReadFrame]]] = deque()
    try:
        for task in tasks:
            waiting.append((task, readers.submit(_read, task)))
            if len(waiting) > ahead:
                yield waiting.popleft()
        while waiting:
            yield waiting.popleft()
    finally:
        for _, future in waiting:
            future.cancel()


def _read(task: Task) -> ReadFrame:
    watch = Stopwatch()
    with watch("read"):
        known = known_inputs(task)
        inputs = read_inputs(task.request)
    return ReadFrame(inputs=inputs, known=known, watch=watch)


def _read_and_refined(
    refiner: Refiner | None, read: Future[ReadFrame]
) -> tuple[ReadFrame, Refiner, RefinedFrame]:
    frame = read.result()
    if refiner is None:
        raise InputError("no frame could be read when the batch began; run it again")
    with frame.watch("refine"):
        return frame, refiner, refiner.refine(frame.inputs)


def _write(
    state: BatchState, task: Task, frame: ReadFrame, refiner: Refiner, refined: RefinedFrame
) -> Row:
    try:
        state.begin(task)
        outcome = write_refined(task.outputs, refiner, frame.inputs, refined, frame.watch)
        written = {
            kind: path.relative_to(state.output).as_posix()
            for kind, path in task.outputs.by_kind().items()
        }
        row = row_of(task.name, _paths(task), outcome.record, written)
        state.finish(task, "diverged" if outcome.diverged else "done", row, frame.known)
    except StorageError:
        raise
    except Exception as error:
        return _failed(state, task, error)
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
