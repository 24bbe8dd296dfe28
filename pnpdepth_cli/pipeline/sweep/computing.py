"""The runs of one frame after the other, in this process or on a worker of a cluster."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import groupby
from typing import Any, TypeVar

from pnpdepth_cli.errors import DeviceError, PnpDepthError, StorageError
from pnpdepth_cli.frames.opened import SplitCache
from pnpdepth_cli.io.dataset.frame import Frame
from pnpdepth_cli.pipeline.batch.frames import Task
from pnpdepth_cli.pipeline.batch.reading import read_frame
from pnpdepth_cli.pipeline.cluster.pool import Lost, WorkerPool
from pnpdepth_cli.pipeline.cluster.worker import Done, Work
from pnpdepth_cli.pipeline.refinement.inputs import Inputs
from pnpdepth_cli.pipeline.refinement.load_refiner import load_refiner
from pnpdepth_cli.pipeline.refinement.refiner import Refiner
from pnpdepth_cli.pipeline.sweep.plan import Run
from pnpdepth_cli.pipeline.sweep.points import Sampling, frame_points
from pnpdepth_cli.pipeline.sweep.running import result_of

T = TypeVar("T")
Result = dict[str, Any] | PnpDepthError
"""What the journal has of a run, or why it failed."""
_RESOLVE_POINTS = 500
"""Points of the ground truth that the definition is resolved on; the paper uses 500 indoors."""


@dataclass(frozen=True, kw_only=True)
class FirstFrame:
    """The frame that a network's definition is resolved on."""

    task: Task
    """How it is read, and which network is refined with."""
    frame: Frame
    """Its files."""
    seed: int
    """Of the points."""
    layer: str | None
    """A layer to cut at, as a network may have no default."""
    others: tuple[tuple[Task, Frame], ...] = ()
    """Further frames, which decide the input range as well."""

    def read(self) -> Inputs:
        """Returns it with points of the ground truth, so as not to depend on what is varied.

        Raises:
            InputError: It cannot be read.
        """
        return self._read(self.task, self.frame)

    def _read(self, task: Task, frame: Frame) -> Inputs:
        inputs = read_frame(task)
        known = 0 if inputs.gt is None else int((inputs.gt > 0).sum())
        some = Sampling(sensor="uniform", points=str(min(_RESOLVE_POINTS, known)))
        points = frame_points(some, self.seed, inputs, task.request, frame)
        return replace(inputs, points=points)

    def _read_others(self) -> list[Inputs]:
        """Those that can be read."""
        read = []
        for task, frame in self.others:
            with contextlib.suppress(PnpDepthError):  # it is read again later, which reports this
                read.append(self._read(task, frame))
        return read

    def load(self, inputs: Inputs, device: str | None = None) -> Refiner:
        """Returns the network, resolved on what `read` returned.

        Args:
            inputs: The frame.
            device: Where it is loaded; None for the request's.
        """
        request = self.task.request.with_fields(layer=self.layer)
        if device is not None:
            request = request.with_fields(device=device)
        return load_refiner(request, inputs, self._read_others)


def by_frame(runs: Sequence[Run]) -> list[list[Run]]:
    """Returns the runs of each frame, which follow each other."""
    return [list(group) for _, group in groupby(runs, key=lambda run: run.frame.name)]


def results_of_frame(runs: Sequence[Run], cache: SplitCache) -> Iterator[tuple[Run, Result]]:
    """Yields the runs of one frame with their results; the frame is read once."""
    inputs = _result_or_error(read_frame, runs[0].task)
    for _, of_points in groupby(runs, key=lambda run: (run.sampling, run.seed)):
        same_points = list(of_points)
        failed = isinstance(inputs, PnpDepthError)
        drawn = inputs if failed else _result_or_error(_drawn, same_points[0], inputs)
        for run in same_points:
            if isinstance(drawn, PnpDepthError):
                yield run, drawn
            else:
                yield run, _result_or_error(result_of, run, drawn, cache)


def _result_or_error(read: Callable[..., T], *arguments: Any) -> T | PnpDepthError:
    """The result, or the error of a frame that cannot be used."""
    try:
        return read(*arguments)
    except (StorageError, DeviceError):
        raise
    except PnpDepthError as error:
        return error


def _drawn(run: Run, inputs: Inputs) -> Inputs:
    """The frame with the run's points."""
    points = frame_points(run.sampling, run.seed, inputs, run.task.request, run.frame)
    return replace(inputs, points=points)


def spread_results(
    runs: Sequence[Run], first: FirstFrame, pool: WorkerPool
) -> Iterator[tuple[Run, Result]]:
    """Yields the runs with their results, as workers of a cluster compute them frame by frame."""
    for part in pool.results(SweepJob(first=first), by_frame(runs)):
        for frame_runs, results in part:
            for number, run in enumerate(frame_runs):
                lost = isinstance(results, Lost)
                yield run, PnpDepthError(results.message) if lost else results[number]


@dataclass(frozen=True, kw_only=True)
class SweepJob:
    """Computes the runs of frames on a worker."""

    first: FirstFrame
    """The frame that the network's definition is resolved on."""

    @contextmanager
    def opened(self) -> Iterator[Work]:
        """Yields a function of the runs of several frames."""
        refiner = self.first.load(self.first.read())
        with SplitCache(refiner.network) as cache:

            def compute(frames: Sequence[Sequence[Run]], checked: bool, finish: bool) -> Done:
                results = [[result for _, result in results_of_frame(f, cache)] for f in frames]
                return Done(results=results)

            yield compute
