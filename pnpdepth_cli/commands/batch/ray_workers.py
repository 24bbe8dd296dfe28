"""A batch on a Ray cluster: workers refine a few frames a call, and Ray restarts those that die."""

from __future__ import annotations

import os
import platform
import socket
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, suppress
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from pnpdepth_cli import __version__
from pnpdepth_cli.budget import chosen_max_pixels, set_max_pixels
from pnpdepth_cli.commands.batch.frames import task_of
from pnpdepth_cli.commands.batch.ray_cluster import connected
from pnpdepth_cli.commands.batch.request import BatchRequest, RayWorkers
from pnpdepth_cli.commands.batch.state import BatchState, Row, remove_all_leftovers
from pnpdepth_cli.errors import ClusterError, ModelError, UsageError
from pnpdepth_cli.io.dataset import Frame
from pnpdepth_cli.io.file_bytes import one_line
from pnpdepth_cli.io.lock import LOCKS
from pnpdepth_cli.io.remote import RemotePath

if TYPE_CHECKING:
    from pnpdepth_cli.commands.batch.running import OpenNetwork, References

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


class Job(NamedTuple):
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
    shared: list[Path]
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
        check_node(self._job.versions, self._job.shared)

    def refine(self, frames: Sequence[Frame], settings_worked: bool) -> tuple[list[Row], list[str]]:
        """Returns the rows of the frames, and notes, after their results are written."""
        from pnpdepth_cli.commands.batch.running import opened_network, refine_tasks

        request = self._job.request
        if self._network is None:
            opened = opened_network(request, self._job.references, self._notes.append)
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
    reported as failed. Arguments and errors are as of `refine_tasks`, with ClusterError if the
    cluster cannot be used.
    """
    shared = [request.source]
    if not isinstance(request.output, RemotePath):
        shared += [path.absolute() for path in request.output.glob(LOCKS)]
    job = Job(
        request, references, state.model, str(Path.cwd()), software(), shared,
        workers.options.cpus_per_worker, chosen_max_pixels(),
    )  # fmt: skip
    with connected(workers) as (ray, count, resources):
        say(f"Ray workers: starting {count:,}, each with {workers.each}")
        options = {"scheduling_strategy": "SPREAD", "max_restarts": _RESTARTS, **resources}
        actor, reference = ray.remote(Worker).options(**options), ray.put(job)
        actors = [actor.remote(reference) for _ in range(count)]
        try:
            yield from rows_of_actors(
                ray, actors, to_do, retries=workers.options.retries, worked=settings_worked,
                lost=lambda frame, why: state.fail(task_of(request, frame), why), say=say,
                stopped=stopped,
            )  # fmt: skip
        finally:
            for each in actors:
                ray.kill(each)
    if request.shard is None and not isinstance(request.output, RemotePath):
        remove_all_leftovers(request.output)  # of workers that died


class _Call(NamedTuple):
    """Frames that go to a worker together; none while it starts."""

    actor: Any
    frames: Sequence[Frame] = ()
    deaths: int = 0
    """How often a worker died of this frame, if it is a single one."""
    worked: bool = False
    """True if a frame was refined with these settings before the call."""


def rows_of_actors(
    ray: Any,
    actors: Sequence[Any],
    to_do: Sequence[Frame],
    *,
    retries: int,
    worked: bool,
    lost: Callable[[Frame, str], Row],
    say: Callable[[str], None],
    stopped: Callable[[], bool],
) -> Iterator[Row]:
    """Hands out frames, a call at a time for each worker; yields the rows as they are done.

    The frames of a worker that dies are handed out again, one by one.

    Args:
        ray: Ray, connected.
        actors: The workers, which may be starting.
        to_do: The frames.
        retries: How often a single frame whose worker died is tried again.
        worked: True if a frame was refined with these settings before.
        lost: Returns the row of a frame whose worker died each time, by frame and reason.
        say: Receives notes.
        stopped: True if nothing more is to be handed out.
    """
    idle, said, running = list[Any](), set[str](), dict[Any, _Call]()
    again, position = deque[tuple[Sequence[Frame], int]](), 0

    def start(actor: Any) -> None:
        running[actor.ready.options(max_task_retries=-1).remote()] = _Call(actor)

    for actor in actors:
        start(actor)
    while True:
        over = stopped() or (not again and position == len(to_do))
        if not over and idle:
            if again:
                frames, deaths = again.popleft()
            else:
                size = min(_FRAMES_OF_A_CALL, (len(to_do) - position) // (2 * len(actors)))
                frames, deaths = to_do[position : position + max(1, size)], 0
                position += len(frames)
            actor = idle.pop()
            running[actor.refine.remote(frames, worked)] = _Call(actor, frames, deaths, worked)
            continue
        busy = any(call.frames for call in running.values())
        if over and not busy:
            return
        ended, _ = ray.wait(list(running), timeout=None if busy else _NO_WORKER_S)
        if not ended:
            raise ClusterError(
                f"no worker has started for {_NO_WORKER_S:.0f} s; check the cluster with `ray"
                " status`, and run the same command to continue"
            )
        call = running.pop(ended[0])
        try:
            rows, notes = ray.get(ended[0]) or ((), ())
        except ray.exceptions.RayTaskError as error:
            of_settings = isinstance(error.cause, ModelError) or type(error.cause) is UsageError
            if call.worked or not (call.frames and of_settings and worked):
                raise error.cause if isinstance(error.cause, Exception) else error from None
            again.append((call.frames, call.deaths))  # of one frame, as others worked meanwhile
            idle.append(call.actor)
            continue
        except ray.exceptions.RayError as error:
            reason = reason_of(error)
            if not call.frames:
                raise ClusterError(f"a worker died {_RESTARTS} times: {reason}") from None
            say(f"warning: a worker died ({reason}); Ray starts another one")
            start(call.actor)
            deaths = call.deaths + (len(call.frames) == 1)
            if deaths > retries:
                yield lost(call.frames[0], f"its worker died {deaths} times: {reason}")
            else:
                again.extend(([frame], deaths) for frame in call.frames)
            continue
        idle.append(call.actor)
        for note in notes:
            if note not in said:
                said.add(note)
                say(note)
        worked |= any(row["status"] != "failed" for row in rows)
        yield from rows


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
