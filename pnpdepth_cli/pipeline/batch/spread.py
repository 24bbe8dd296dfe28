"""A batch on a Ray cluster: workers read, refine and write; the driver keeps the manifest."""

from __future__ import annotations

from collections import deque
from collections.abc import Generator, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pnpdepth_cli.io.dataset.frame import Frame
from pnpdepth_cli.io.dataset.frame_list import FrameList
from pnpdepth_cli.io.journal import EncodedLine
from pnpdepth_cli.io.remote.address import RemotePath
from pnpdepth_cli.pipeline.batch.frames import (
    Task,
    deciding,
    registering,
    source_files,
    task_of,
)
from pnpdepth_cli.pipeline.batch.profile import BatchProfile
from pnpdepth_cli.pipeline.batch.request import BatchRequest
from pnpdepth_cli.pipeline.batch.run import BatchRun
from pnpdepth_cli.pipeline.batch.state import (
    KEY,
    BatchState,
    Fingerprints,
    Line,
    Status,
    failed_line,
    finished_line,
    remove_all_leftovers,
)
from pnpdepth_cli.pipeline.batch.summary import failed_row
from pnpdepth_cli.pipeline.cluster.options import Spread, spread_of
from pnpdepth_cli.pipeline.cluster.pool import Lost, WorkerPool, worker_pool
from pnpdepth_cli.pipeline.cluster.worker import Done, Work

if TYPE_CHECKING:
    from pnpdepth_cli.pipeline.batch.groups import FrameGroups

_SEARCHED = 64
"""Frames that one call looks through for the first that can be read."""


def spread_request(request: BatchRequest) -> tuple[BatchRequest, Spread | None]:
    """Returns the request of each worker, and the workers; None for this process alone.

    Raises:
        UsageError: The devices cannot be spread over.
    """
    spread = spread_of(request.refine.network.device, request.cluster)
    if spread is None:
        return request, None
    refine = request.refine.with_fields(device=spread.device)
    return replace(request, refine=refine), spread


def spread_rows(
    request: BatchRequest,
    spread: Spread,
    frames: Sequence[Frame],
    to_do: FrameList,
    run: BatchRun,
    *,
    proven: bool,
) -> Generator[dict[str, Any], None, None]:
    """Refines and records each frame on the workers; yields the rows as they are done.

    Args:
        request: As `spread_request` returns it.
        spread: The workers.
        frames: All frames, the first of which decide what the network leaves open.
        to_do: The frames to refine.
        run: What the frames share.
        proven: True if a frame was refined with these settings before.

    Raises:
        PnpDepthError: As of `run_tasks`.
        ClusterError: The cluster cannot be used.
    """
    state = run.state
    assert isinstance(state, BatchState)
    shared = worker_pool(spread, run.say, inputs=[request.source], output=state.output)
    with shared as pool, run.profile.wall():
        first = _first_readable(request, frames, pool)
        job = RefineJob(
            request=request,
            model=state.model,
            deciding=() if first is None else (frames[first], *deciding(frames, first)),
            registering=() if first is None else tuple(registering(frames, first)),
        )
        for part in pool.results(
            job,
            largest_first(to_do),
            begin=lambda begun: state.begin_all(frame.name for frame in begun),
            stopped=run.stopped,
            proven=proven,
        ):
            done = [
                _given_up(state, request, frame, result) if isinstance(result, Lost) else result
                for frame, result in part
            ]
            state.record(*(each.line for each in done))
            yield from (each.row for each in done)
        run.profile.add_workers(pool.figures())
    if request.shard is None:  # else other shards may be writing there
        remove_all_leftovers(state.folder.local)  # of workers that died


def largest_first(frames: FrameList) -> FrameList:
    """Returns the frames by falling size of their first file, in powers of two, else in order.

    A large frame that is begun last would keep one worker busy while the others wait.
    """
    sizes = [_magnitude(source_files(frame)[0]) for frame in frames]
    return frames.taken(sorted(range(len(sizes)), key=lambda number: -sizes[number]))


def _magnitude(path: Path) -> int:
    """The bit length of the file's size; 0 if it is unknown, as in a store."""
    try:
        return 0 if isinstance(path, RemotePath) else path.stat().st_size.bit_length()
    except OSError:
        return 0


def _first_readable(request: BatchRequest, frames: Sequence[Frame], pool: WorkerPool) -> int | None:
    """Which frame is the first that a run in one process would resolve its network on."""
    for start in range(0, len(frames), _SEARCHED):
        offset = pool.call(first_readable, request, frames[start : start + _SEARCHED])
        if offset is not None:
            return start + int(offset)
    return None


@dataclass(frozen=True, kw_only=True)
class DoneFrame:
    """A frame that a worker has done; the driver need not parse its line."""

    row: dict[str, Any]
    """For a listener: the summary's row if a report is drawn of it, else its first fields."""
    line: EncodedLine
    """For the manifest."""

    @classmethod
    def of(cls, line: Line, *, whole: bool) -> DoneFrame:
        """Returns what the driver takes of a line, with its whole row or the first fields of it."""
        row = line["row"]
        shown = row if whole else {name: row[name] for name in ("name", "status", "message")}
        return cls(row=shown, line=EncodedLine.of(line, KEY))


def _given_up(state: BatchState, request: BatchRequest, frame: Frame, lost: Lost) -> DoneFrame:
    task = task_of(request, frame)
    paths = {part: str(path) for part, path in task.inputs.items()}
    line = failed_line(state, task, failed_row(task.name, paths, lost.message))
    return DoneFrame.of(line, whole=True)


def first_readable(request: BatchRequest, frames: Sequence[Frame]) -> int | None:
    """Returns which frame is the first that can be read; to be called on a worker."""
    from pnpdepth_cli.pipeline.batch.resolving import readable

    readable_ones = (
        i for i, frame in enumerate(frames) if readable(task_of(request, frame)) is not None
    )
    return next(readable_ones, None)


@dataclass(frozen=True, kw_only=True)
class RefineJob:
    """Refines frames on a worker; its results are `DoneFrame`s."""

    request: BatchRequest
    """How, on one device."""
    model: dict[str, Any]
    """The network's `model_identity`."""
    deciding: tuple[Frame, ...]
    """The first frame that can be read, and others that candidates are compared on."""
    registering: tuple[Frame, ...] = ()
    """The frames that decide how images are moved into the frame of the points."""

    @contextmanager
    def opened(self) -> Iterator[Work]:
        """Yields a function that refines frames; the network is loaded and cut once."""
        from pnpdepth_cli.pipeline.batch.resolving import opened_groups, readable, refiner_on

        notes: list[str] = []
        refiner = None
        if self.deciding:
            first, *others = (task_of(self.request, frame) for frame in self.deciding)
            inputs = readable(first)
            if inputs is not None:
                many = [task_of(self.request, frame) for frame in self.registering]
                refiner = refiner_on(first, inputs, others, many, notes.append)
        collector = LineCollector(output=self.request.output, model=self.model)
        run = BatchRun(
            state=collector, profile=BatchProfile(), say=notes.append, stopped=lambda: False,
            workers=self.request.workers, batch_size=self.request.batch_size,
        )  # fmt: skip
        with (
            opened_groups(refiner, run.batch_size, run.say) as groups,
            closing(FrameStream(self.request, groups, run)) as stream,
        ):

            def refine(frames: Sequence[Frame], proven: bool, finish: bool) -> Done:
                done = stream.refined(frames, proven=proven, finish=finish)
                said = tuple(notes)
                notes.clear()
                return replace(done, notes=said)

            yield refine


class FrameStream:
    """Refines frames that come in pieces, and reads and writes across the ends of pieces.

    Args:
        request: How, on one device.
        groups: The network, open; None if no frame could be read.
        run: What the frames share; its state is a `LineCollector`.
    """

    def __init__(self, request: BatchRequest, groups: FrameGroups | None, run: BatchRun) -> None:
        assert isinstance(run.state, LineCollector)
        self._request, self._groups, self._run = request, groups, run
        self._lines = run.state.lines
        self._frames: deque[Frame] = deque()
        self._finish = True
        self._rows: Generator[dict[str, Any] | None, None, None] | None = None

    def refined(self, frames: Sequence[Frame], *, proven: bool, finish: bool) -> Done:
        """Returns a `DoneFrame` of each frame that is refined and written up to now.

        Args:
            frames: Further frames.
            proven: True if a frame was refined with these settings before.
            finish: Whether to wait for all frames. If not, it returns when the last was taken to
                be read.
        """
        from pnpdepth_cli.pipeline.batch.running import run_arriving

        self._frames.extend(frames)
        self._finish = finish
        if self._rows is None:
            self._rows = run_arriving(self._tasks(), self._groups, self._run, proven=proven)
        rows: list[dict[str, Any]] = []
        try:
            while (row := next(self._rows)) is not None:
                rows.append(row)
        except StopIteration:
            self._rows = None
        except BaseException:
            self.close()
            raise
        whole = self._request.html is not None
        return Done(
            results=[DoneFrame.of(self._lines.pop(row["name"]), whole=whole) for row in rows],
            proves=any(row["status"] != "failed" for row in rows),
            multiple=self._groups.largest if self._groups else 1,
            figures=self._run.profile.summary(),
        )

    def close(self) -> None:
        """Drops the frames that are not refined yet."""
        self._frames.clear()
        self._lines.clear()
        if self._rows is not None:
            self._rows.close()
            self._rows = None

    def _tasks(self) -> Iterator[Task | None]:
        while self._frames or not self._finish:
            yield task_of(self._request, self._frames.popleft()) if self._frames else None


@dataclass(frozen=True, kw_only=True)
class LineCollector:
    """Keeps the lines of a manifest until the driver takes them."""

    output: Path
    """The output folder."""
    model: dict[str, Any]
    """The network's `model_identity`."""
    lines: dict[str, Line] = field(default_factory=dict)
    """By the name of the frame."""

    def begin(self, task: Task) -> None:
        """Does nothing: the driver has recorded it."""

    def finish(self, task: Task, status: Status, row: dict[str, Any], known: Fingerprints) -> None:
        """Keeps the line of a frame that is done."""
        self.lines[task.name] = finished_line(self, task, status, row, known)

    def fail(self, task: Task, row: dict[str, Any]) -> None:
        """Keeps the line of a frame that failed."""
        self.lines[task.name] = failed_line(self, task, row)
