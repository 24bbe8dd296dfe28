"""A batch on a Ray cluster: workers refine a few frames a call, and Ray restarts those that die."""

from __future__ import annotations

import os
import platform
import socket
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field, replace
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
    from pnpdepth_cli.pipeline.batch.running import OpenNetwork

_FRAMES_OF_A_CALL = 8
"""So many are read and written beside the network; fewer at the end, to balance the workers."""
_NO_WORKER_S = 300.0
"""How long a cluster may take to start a worker, such as on a machine that it starts first."""
_THREADS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")
_LIBRARIES = ("torch", "numpy", "opencv-python-headless")


def software() -> dict[str, str]:
    """Returns the versions that have to be equal on all nodes; imports none of the libraries."""
    return {
        "pnpdepth": __version__,
        "python": platform.python_version(),
        **{name: metadata.version(name) for name in _LIBRARIES},
    }


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
        self._network: OpenNetwork | None = None
        self._notes: list[str] = []

    def ready(self) -> None:
        """Raises ClusterError if this node differs from the driver's."""
        node, own = socket.gethostname(), software()
        for name, version in self._job.versions.items():
            if own.get(name) != version:
                raise ClusterError(
                    f"node {node} has {name} {own.get(name)}, and the driver {version}; install the"
                    " same version on all nodes"
                )
        for path in self._job.shared:
            if not path.exists():
                what = "the output folder" if path.match(LOCKS) else str(path)
                raise ClusterError(
                    f"node {node} does not see {what}; name a folder that all nodes share"
                )

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


@dataclass(kw_only=True)
class _Call:
    """Frames that a worker refines; none while it starts."""

    actor: Any
    frames: Sequence[Frame] = ()
    deaths: int = 0
    """How often a worker died of this frame, if it is a single one."""


@dataclass(kw_only=True)
class _Calls:
    """The calls that run, and what is to be handed out."""

    waiting: deque[_Call] = field(default_factory=deque)
    """Calls that are to be repeated."""
    running: dict[Any, _Call] = field(default_factory=dict)
    """By their references."""
    idle: list[Any] = field(default_factory=list)
    """Workers that wait for frames."""
    doubtful: list[tuple[_Call, PnpDepthError]] = field(default_factory=list)
    """Calls that failed by an error of the settings, if no frame has been refined yet."""


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
        options = {"scheduling_strategy": "SPREAD", "max_restarts": -1, **cluster.resources}
        actor, reference = ray.remote(Worker).options(**options), ray.put(job)
        actors = [actor.remote(reference) for _ in range(count)]
        try:
            yield from _rows_of(
                ray, actors, to_do, request, state, workers.options.retries,
                worked=settings_worked, say=say, stopped=stopped,
            )  # fmt: skip
        finally:
            for each in actors:
                ray.kill(each)
    if request.shard is None and not isinstance(request.output, RemotePath):
        remove_all_leftovers(request.output)  # of workers that died


def _rows_of(
    ray: Any,
    actors: Sequence[Any],
    to_do: Sequence[Frame],
    request: BatchRequest,
    state: BatchState,
    retries: int,
    *,
    worked: bool,
    say: Callable[[str], None],
    stopped: Callable[[], bool],
) -> Iterator[Row]:
    calls, handed_out, said = _Calls(), 0, set[str]()
    for actor in actors:
        calls.running[_ready(actor)] = _Call(actor=actor)
    while True:
        while calls.idle and not calls.doubtful and not stopped():
            if calls.waiting:
                call = calls.waiting.popleft()
            else:
                left = len(to_do) - handed_out
                size = max(1, min(_FRAMES_OF_A_CALL, left // (2 * len(actors))))
                call = _Call(actor=None, frames=to_do[handed_out : handed_out + size])
                handed_out += len(call.frames)
            if not call.frames:
                break
            call.actor = calls.idle.pop()
            calls.running[call.actor.refine.remote(call.frames, worked)] = call
        busy = any(call.frames for call in calls.running.values())
        if not busy and (stopped() or (not calls.waiting and handed_out == len(to_do))):
            if calls.doubtful and not stopped():
                raise calls.doubtful[0][1]
            return
        if not busy and calls.doubtful:
            raise calls.doubtful[0][1]
        ended, _ = ray.wait(list(calls.running), timeout=None if busy else _NO_WORKER_S)
        if not ended:
            raise ClusterError(
                f"no worker has started for {_NO_WORKER_S:.0f} s; check the cluster with `ray"
                " status`, and run the same command to continue"
            )
        call = calls.running.pop(ended[0])
        try:
            result = ray.get(ended[0])
        except ray.exceptions.RayTaskError as error:
            cause = error.cause
            of_settings = isinstance(cause, ModelError) or type(cause) is UsageError
            if not call.frames or not of_settings:
                raise cause if isinstance(cause, Exception) else error from None
            calls.idle.append(call.actor)
            if worked:
                calls.waiting.append(call)
            else:
                calls.doubtful.append((call, cause))
        except ray.exceptions.RayError as error:
            reason = reason_of(error)
            if not call.frames:
                raise ClusterError(f"workers die when they start: {reason}") from None
            say(f"warning: a worker died ({reason}); Ray starts another one")
            calls.running[_ready(call.actor)] = _Call(actor=call.actor)
            deaths = call.deaths + (len(call.frames) == 1)
            if deaths > retries:
                (frame,) = call.frames
                message = f"its worker died {deaths} times: {reason}"
                yield state.fail(task_of(request, frame), message)
            else:
                alone = [_Call(actor=None, frames=[f], deaths=deaths) for f in call.frames]
                calls.waiting.extendleft(reversed(alone))
        else:
            calls.idle.append(call.actor)
            rows, notes = result or ((), ())
            for note in notes:
                if note not in said:
                    said.add(note)
                    say(note)
            if any(row["status"] != "failed" for row in rows):
                worked = True
                calls.waiting.extend(replace(call, actor=None) for call, _ in calls.doubtful)
                calls.doubtful.clear()
            yield from rows


def _ready(actor: Any) -> Any:
    """The reference of a call that ends when the worker has started, also again."""
    return actor.ready.options(max_task_retries=3).remote()


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
