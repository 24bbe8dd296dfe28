"""Refines frames: threads read them in advance, the network refines, other threads write.

The network runs only in the calling thread, as it is patched while it is cut. The queues between
the threads are bounded, so memory does not grow with the number of frames.
"""

from __future__ import annotations

import time
import traceback
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from pnpdepth_cli.errors import (
    BatchError,
    InputError,
    ModelError,
    PnpDepthError,
    StorageError,
    UsageError,
)
from pnpdepth_cli.frames.frame import Refined, WarmStart
from pnpdepth_cli.frames.refiner import Refiner
from pnpdepth_cli.io.fingerprint import Fingerprint
from pnpdepth_cli.pipeline.batch.frames import Task
from pnpdepth_cli.pipeline.batch.reading import read_task
from pnpdepth_cli.pipeline.batch.state import BatchState, Row
from pnpdepth_cli.pipeline.ordered_pool import in_order
from pnpdepth_cli.pipeline.refinement.inputs import Inputs
from pnpdepth_cli.pipeline.refinement.refine import write_refined
from pnpdepth_cli.pipeline.stopwatch import Stopwatch

_ROUNDING = 1e-3
"""A larger relative difference of plain predictions is more than rounding."""


@dataclass(kw_only=True)
class FrameInMemory:
    """A frame on its way through the network."""

    task: Task
    inputs: Inputs | None = None
    fingerprints: dict[str, Fingerprint] = field(default_factory=dict)
    watch: Stopwatch = field(default_factory=Stopwatch)
    result: Refined | Exception | None = None
    """An error that occurred while it was read or refined. None before."""


def refine_tasks(
    tasks: Iterable[Task],
    network: OpenRefiner | None,
    state: BatchState,
    *,
    threads: int,
    settings_worked: bool,
    stopped: Callable[[], bool] = lambda: False,
) -> Generator[Row, None, None]:
    """Refines and writes each task; yields the summary's row of each, in their order.

    Args:
        tasks: The frames to refine.
        network: The network, open; None if no frame could be read.
        state: Writes the results.
        threads: Number of threads that read, and of threads that write.
        settings_worked: True if a frame was refined with these settings before.
        stopped: True if no further frame is to be begun.

    Raises:
        StorageError: When nothing more can be written.
        ModelError: For an error of the network before any frame was refined.
        UsageError: For an error of the settings before any frame was refined.
    """

    def refined(reading: Iterable[FrameInMemory]) -> Iterator[FrameInMemory]:
        worked = settings_worked
        for group in _groups(reading, lambda: 1 if network is None else network.batch_size):
            if stopped():
                return
            _refine(group, network)
            for frame in group:
                worked |= isinstance(frame.result, Refined)
                fatal = StorageError if worked else (StorageError, ModelError, UsageError)
                if isinstance(frame.result, fatal):
                    raise frame.result
                if frame.task.written:
                    yield frame

    def written(frame: FrameInMemory) -> Row:
        return _write(frame, network, state)

    with (
        closing(in_order(_read, tasks, threads)) as reading,
        closing(in_order(written, refined(reading), threads)) as rows,
    ):
        yield from rows


def _groups(
    frames: Iterable[FrameInMemory], size: Callable[[], int]
) -> Iterator[list[FrameInMemory]]:
    """The frames in their order, in groups of at most so many of one shape.

    A frame that could not be read is in the group of those before it.
    """
    group: list[FrameInMemory] = []
    shape = None
    for frame in frames:
        if frame.inputs is not None:
            if shape not in (None, frame.inputs.size):
                yield group
                group = []
            shape = frame.inputs.size
        group.append(frame)
        if len(group) >= size():
            yield group
            group, shape = [], None
    if group:
        yield group


def _refine(group: Sequence[FrameInMemory], network: OpenRefiner | None) -> None:
    """Sets the results of the frames that were read."""
    frames = [frame for frame in group if frame.inputs is not None]
    if network is None:
        for frame in frames:
            frame.result = InputError("no frame could be read when the batch began; run it again")
        return
    if not frames:
        return
    start = time.perf_counter()
    results = network.refine([frame.inputs for frame in frames if frame.inputs is not None])
    seconds = (time.perf_counter() - start) / len(frames)
    for frame, result in zip(frames, results, strict=True):
        frame.watch.add("refine", seconds)
        frame.result = result


class OpenRefiner:
    """Refines frames of one size, several together where the user asks for it.

    Args:
        refiner: The network and its settings.
        batch_size: How many frames go together.
        say: Receives notes.
    """

    def __init__(self, refiner: Refiner, batch_size: int, say: Callable[[str], None]) -> None:
        self.refiner, self._say = refiner, say
        self._carried: dict[str, WarmStart] = {}  # of the last frame, by the first of its window
        fixed = (
            not refiner.is_default
            and not refiner.settings.moves_weights
            and refiner.settings.tile is None
        )
        if batch_size > 1 and not fixed:
            say("batch size: 1; only frames of a fixed network without tiles go together")
        self.batch_size = batch_size if fixed else 1
        self._checked = False

    def refine(self, group: Sequence[Inputs]) -> Sequence[Refined | Exception]:
        """Returns the refined frames, all of one size; for one that fails, its error."""
        if len(group) > 1 and not any(inputs.window for inputs in group):
            together = self._together(group)
            if together is not None:
                return together
        return [self._alone(inputs) for inputs in group]

    def _together(self, group: Sequence[Inputs]) -> list[Refined | Exception] | None:
        """The frames refined in one pass; None if the network does not take them together."""
        try:
            frames = self.refiner.refine_together(group)
            if not self._checked:
                self._check_independent(group[0], frames[0])
        except PnpDepthError as error:
            self._say(f"{len(group)} frames are refined one at a time; together: {error}")
            if isinstance(error, BatchError):
                self.batch_size = 1
            return None
        note = f"refined together with {len(group) - 1} others, which alters the last bits"
        return [
            replace(frame, notes=(*frame.notes, note)) if isinstance(frame, Refined) else frame
            for frame in frames
        ]

    def _check_independent(self, inputs: Inputs, together: Refined | PnpDepthError) -> None:
        """Raises BatchError if the frames of a group influence each other."""
        alone = self._alone(inputs)
        if not isinstance(alone, Refined) or not isinstance(together, Refined):
            return
        self._checked = True
        split = self.refiner.split
        if split is None or not split.static_graph:
            raise BatchError("the network's control flow depends on image values")
        if not np.allclose(alone.before, together.before, rtol=_ROUNDING, atol=0):
            raise BatchError("frames that go together influence each other")

    def _alone(self, inputs: Inputs) -> Refined | Exception:
        try:
            if not inputs.window:
                return self.refiner.refine_frame(inputs)
            first = inputs.window[0]
            carried = (
                WarmStart() if len(inputs.window) == 1 else self._carried.pop(first, WarmStart())
            )
            frame = self.refiner.refine_next(inputs, carried)
        except Exception as error:  # concerns this frame only
            return error
        self._carried = {first: frame.carried or WarmStart()}
        return replace(frame, carried=None)


@contextmanager
def opened_network(
    refiner: Refiner | None, batch_size: int, say: Callable[[str], None]
) -> Iterator[OpenRefiner | None]:
    """Yields the network, open for any number of frames; None for None."""
    if refiner is None:
        yield None
        return
    with refiner:
        yield OpenRefiner(refiner, batch_size, say)


def _read(task: Task) -> FrameInMemory:
    frame = FrameInMemory(task=task)
    try:
        with frame.watch("read"):
            frame.inputs, frame.fingerprints = read_task(task)
    except Exception as error:  # concerns this frame only
        frame.result = error
    return frame


def _write(frame: FrameInMemory, network: OpenRefiner | None, state: BatchState) -> Row:
    """Writes a frame's results, or why there are none; returns the summary's row."""
    task, inputs, result = frame.task, frame.inputs, frame.result
    if not isinstance(result, Refined):
        assert result is not None
        return state.fail(task, _message(result))
    assert network is not None
    assert inputs is not None
    try:
        return state.write(
            task,
            frame.fingerprints,
            lambda outputs: write_refined(outputs, network.refiner, inputs, result, frame.watch),
        )
    except StorageError:
        raise
    except Exception as error:
        return state.fail(task, _message(error))


def _message(error: Exception) -> str:
    if isinstance(error, PnpDepthError):
        return str(error)
    line = traceback.extract_tb(error.__traceback__)[-1]
    return (
        f"a bug of pnpdepth: {type(error).__name__}: {error} ({Path(line.filename).name}, line"
        f" {line.lineno})"
    )
