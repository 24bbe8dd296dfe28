"""A batch on a Ray cluster: workers refine a few frames a call, and Ray restarts those that die."""

from __future__ import annotations

import os
import platform
import socket
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pnpdepth_cli import __version__
from pnpdepth_cli.budget import chosen_max_pixels, set_max_pixels
from pnpdepth_cli.errors import ClusterError, ModelError, PnpDepthError, UsageError
from pnpdepth_cli.io.dataset.frame import Frame
from pnpdepth_cli.io.file_bytes import one_line
from pnpdepth_cli.io.lock import LOCKS
from pnpdepth_cli.io.remote.address import RemotePath
from pnpdepth_cli.pipeline.batch.frames import task_of
from pnpdepth_cli.pipeline.batch.request import BatchRequest
from pnpdepth_cli.pipeline.batch.resolving import References, load_batch_refiner
from pnpdepth_cli.pipeline.batch.state import BatchState, Row, remove_all_leftovers
from pnpdepth_cli.pipeline.cluster.connection import connected
from pnpdepth_cli.pipeline.cluster.options import RayWorkers

if TYPE_CHECKING:
    from pnpdepth_cli.pipeline.batch.running import OpenRefiner

_FRAMES_OF_A_CALL = 8
"""So many are read and written beside the network; fewer at the end, to balance the workers."""
_NO_WORKER_S = 300.0
"""How long a cluster may take to start a worker, such as on a machine that it starts first."""
_RESTARTS = 100
"""How often Ray starts a worker again that dies."""
_THREADS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")
_LIBRARIES = ("torch", "numpy", "opencv-python-headless")


def software() -> dict[str, str]:
    """Returns the versions that have to be equal on all nodes; imports none of the libraries."""
    return {
        "pnpdepth": __version__,
        "python": platform.python_version(),
        **{name: metadata.version(name) for name in _LIBRARIES},
    }


def check_node(versions: Mapping[str, str], shared: Sequence[Path]) -> None:
    """Raises ClusterError if this machine has other versions, or does not see the shared files."""
    node, own = socket.gethostname(), software()
    for name, version in versions.items():
        if own.get(name) != version:
            raise ClusterError(
                f"node {node} has {name} {own.get(name)}, and the driver has {version}; install the"
                " same version on all nodes"
            )
    for path in shared:
        if not path.exists():
            what = "the output folder" if path.match(LOCKS) else str(path)
            raise ClusterError(
                f"node {node} does not see {what}; name a folder that all nodes share"
            )


@dataclass(frozen=True, kw_only=True)
class Job:
    """What every worker is started with."""

    request: BatchRequest
    references: References | None
    """The frames that decide what the network leaves open; None if no frame can be read."""
    model: dict[str, Any]
    """The network's `model_identity`."""
    folder: str
    """The driver's working folder, which relative paths start from."""
    versions: dict[str, str]
    """Of the driver, as `software` returns them."""
    shared: tuple[Path, ...]
    """Files and folders that every worker has to see."""
    threads: int
    """Threads of torch, OpenCV and OpenMP."""
    max_pixels: int | None
    """Of `--max-pixels`."""


class Worker:
    """Refines frames in a process of the cluster; a Ray actor."""

    def __init__(self, job: Job) -> None:
        for name in _THREADS:  # before torch and OpenCV are imported
            os.environ[name] = str(job.threads)
        os.environ.setdefault("GOMP_SPINCOUNT", "3000")
        with suppress(OSError):  # `ready` reports what cannot be seen
            os.chdir(job.folder)
        import cv2
        import torch

        torch.set_num_threads(job.threads)
        cv2.setNumThreads(job.threads)
        set_max_pixels(job.max_pixels)
        self._job = job
        self._state = BatchState(job.request.output, job.model)
        self._open = ExitStack()  # until the process ends
        self._network: OpenRefiner | None = None
        self._notes: list[str] = []

    def ready(self) -> None:
        """Raises ClusterError if this node differs from the driver's."""
        check_node(self._job.versions, self._job.shared)

    def refine(self, frames: Sequence[Frame], settings_worked: bool) -> tuple[list[Row], list[str]]:
        """Returns the rows of the frames, and notes, after their results are written."""
        from pnpdepth_cli.pipeline.batch.running import opened_network, refine_tasks

        request, references = self._job.request, self._job.references
        if self._network is None and references is not None:
            refiner = load_batch_refiner(request, references, self._notes.append)
            opened = opened_network(refiner, request.batch_size, self._notes.append)
            self._network = self._open.enter_context(opened)
        tasks = (task_of(request, frame) for frame in frames)
        rows = list(
            refine_tasks(
                tasks, self._network, self._state,
                threads=request.workers, settings_worked=settings_worked,
            )
        )  # fmt: skip
        notes, self._notes = self._notes, []
        return rows, notes


def rows_of_workers(
    request: BatchRequest,
    workers: RayWorkers,
    references: References | None,
    to_do: Sequence[Frame],
    state: BatchState,
    *,
    settings_worked: bool,
    say: Callable[[str], None],
    stopped: Callable[[], bool],
) -> Iterator[Row]:
    """Refines and writes the frames on Ray workers; yields the rows as they are done.

    A frame whose worker dies is refined by another one. One whose worker dies again and again is
    reported as failed.

    Args:
        request: How, on one device.
        workers: Which workers.
        references: The frames that decide what the network leaves open.
        to_do: The frames to refine.
        state: Records frames that fail.
        settings_worked: True if a frame was refined with these settings before.
        say: Receives notes.
        stopped: True if nothing more is to be handed out.

    Raises:
        PnpDepthError: As of `refine_tasks`.
        ClusterError: The cluster cannot be used.
    """
    shared = [request.source]
    if not isinstance(request.output, RemotePath):
        shared += [path.absolute() for path in request.output.glob(LOCKS)]
    job = Job(
        request=request, references=references, model=state.model, folder=str(Path.cwd()),
        versions=software(), shared=tuple(shared), threads=workers.options.cpus_per_worker,
        max_pixels=chosen_max_pixels(),
    )  # fmt: skip
    with connected(workers) as cluster:
        ray, count = cluster.ray, cluster.workers
        say(f"Ray workers: starting {count:,}, each with {workers.each}")
        options = {"scheduling_strategy": "SPREAD", "max_restarts": _RESTARTS, **cluster.resources}
        actor, reference = ray.remote(Worker).options(**options), ray.put(job)
        actors = [actor.remote(reference) for _ in range(count)]
        try:
            driver = _Driver(ray, actors, to_do, settings_worked, say)
            for result in driver.results(stopped, workers.options.retries):
                if isinstance(result, _Lost):
                    yield state.fail(task_of(request, result.frame), result.message)
                else:
                    yield result
        finally:
            for each in actors:
                ray.kill(each)
    if request.shard is None and not isinstance(request.output, RemotePath):
        remove_all_leftovers(request.output)  # of workers that died


@dataclass(kw_only=True)
class _Call:
    """Frames that go to a worker together; none while it starts."""

    frames: Sequence[Frame] = ()
    deaths: int = 0
    """How often a worker died of this frame, if it is a single one."""
    actor: Any = None


@dataclass(frozen=True, kw_only=True)
class _Lost:
    """A frame whose worker died each time."""

    frame: Frame
    message: str


class _Driver:
    """Hands out frames, a call at a time for each worker, and again those whose worker died.

    Args:
        ray: Ray, connected.
        actors: The workers.
        to_do: The frames.
        settings_worked: True if a frame was refined with these settings before.
        say: Receives notes.
    """

    def __init__(
        self,
        ray: Any,
        actors: Sequence[Any],
        to_do: Sequence[Frame],
        settings_worked: bool,
        say: Callable[[str], None],
    ) -> None:
        self._ray, self._to_do, self._say = ray, to_do, say
        self._workers, self._next, self._worked = len(actors), 0, settings_worked
        self._idle: list[Any] = []
        self._again: deque[_Call] = deque()
        self._unproven: list[tuple[_Call, PnpDepthError]] = []  # failed before any frame succeeded
        self._running: dict[Any, _Call] = {}  # by reference
        self._said: set[str] = set()
        for actor in actors:
            self._start(actor)

    def results(self, stopped: Callable[[], bool], retries: int) -> Iterator[Row | _Lost]:
        """Yields a row for each frame as it is done, or that it is lost.

        Args:
            stopped: True if nothing more is to be handed out.
            retries: How often a single frame is tried again.
        """
        while True:
            if not stopped():
                self._hand_out()
            busy = any(call.frames for call in self._running.values())
            if not busy and stopped():
                return
            if not busy and self._unproven:
                raise self._unproven[0][1]
            if not busy and not self._again and self._next == len(self._to_do):
                return
            timeout = None if busy else _NO_WORKER_S
            ended, _ = self._ray.wait(list(self._running), timeout=timeout)
            if not ended:
                raise ClusterError(
                    f"no worker has started for {_NO_WORKER_S:.0f} s; check the cluster with `ray"
                    " status`, and run the same command to continue"
                )
            yield from self._result(ended[0], retries)

    def _start(self, actor: Any) -> None:
        ready = actor.ready.options(max_task_retries=-1).remote()  # until it has started
        self._running[ready] = _Call(actor=actor)

    def _hand_out(self) -> None:
        while self._idle and not self._unproven:
            if self._again:
                call = self._again.popleft()
            else:
                left = len(self._to_do) - self._next
                size = max(1, min(_FRAMES_OF_A_CALL, left // (2 * self._workers)))
                call = _Call(frames=self._to_do[self._next : self._next + size])
                self._next += len(call.frames)
            if not call.frames:
                return
            call.actor = self._idle.pop()
            self._running[call.actor.refine.remote(call.frames, self._worked)] = call

    def _result(self, reference: Any, retries: int) -> Iterator[Row | _Lost]:
        call, exceptions = self._running.pop(reference), self._ray.exceptions
        try:
            result = self._ray.get(reference)
        except exceptions.RayTaskError as error:
            self._failed(call, error)
            return
        except exceptions.RayError as error:
            yield from self._died(call, reason_of(error), retries)
            return
        self._idle.append(call.actor)
        rows, notes = result or ((), ())
        for note in notes:
            if note not in self._said:
                self._said.add(note)
                self._say(note)
        if any(row["status"] != "failed" for row in rows):
            self._worked = True
            self._again.extend(call for call, _ in self._unproven)
            self._unproven.clear()
        yield from rows

    def _failed(self, call: _Call, error: Any) -> None:
        """Raises what a worker raised, unless other settings of the same run worked."""
        cause = error.cause
        of_settings = isinstance(cause, ModelError) or type(cause) is UsageError
        if not call.frames or not of_settings:
            raise cause if isinstance(cause, Exception) else error from None
        self._idle.append(call.actor)
        if self._worked:
            self._again.append(call)
        else:
            self._unproven.append((call, cause))

    def _died(self, call: _Call, reason: str, retries: int) -> Iterator[_Lost]:
        """Hands out the frames of a dead worker again, one by one; gives up a single one."""
        if not call.frames:
            raise ClusterError(f"a worker died {_RESTARTS} times: {reason}")
        self._say(f"warning: a worker died ({reason}); Ray starts another one")
        self._start(call.actor)
        deaths = call.deaths + (len(call.frames) == 1)
        if deaths > retries:
            yield _Lost(frame=call.frames[0], message=f"its worker died {deaths} times: {reason}")
        else:
            self._again.extend(_Call(frames=[frame], deaths=deaths) for frame in call.frames)


def reason_of(error: Exception) -> str:
    """Returns what Ray says of a worker's death, in a few words."""
    text = one_line(str(error))
    if "error raised in its creation task" in text:
        return str(error).strip().splitlines()[-1][:200]
    if "No module named 'pnpdepth_cli'" in text:
        return "pnpdepth is not installed on its node; install the same version on all nodes"
    if "out of memory" in text.lower() or "OOM" in text.split("Some common causes")[0]:
        return "out of memory"
    if "node" in text.lower() and "died" in text.split("Worker exit type")[0].lower():
        return "its node is gone"
    return "its process ended unexpectedly"
