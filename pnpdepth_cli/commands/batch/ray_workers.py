"""A batch on a Ray cluster: actors refine a few frames a call, and Ray restarts those that die."""

from __future__ import annotations

import os
import platform
import socket
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from importlib import metadata
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, NamedTuple

from pnpdepth_cli import __version__
from pnpdepth_cli.budget import max_pixels_given, set_max_pixels
from pnpdepth_cli.commands.batch.batch_request import LOCAL
from pnpdepth_cli.commands.batch.find_frames import request_of
from pnpdepth_cli.commands.batch.records import Records, remove_all_leftovers
from pnpdepth_cli.dataset.frame_files import FrameFiles
from pnpdepth_cli.dataset.frame_record import FrameRecord
from pnpdepth_cli.errors import ClusterError, UsageError
from pnpdepth_cli.io.atomic import LOCKS
from pnpdepth_cli.io.file_bytes import one_line

if TYPE_CHECKING:
    from pnpdepth_cli.frames.method import Method

_CONNECT_S = 5.0
_FRAMES_OF_A_CALL = 8
"""Frames that are read and written beside the network; fewer where that leaves workers idle."""
_NO_WORKER_S = 300.0
"""How long a cluster may take to start a worker, such as on a machine that it starts first."""
_RETRIES = 2
"""How often a frame is tried again whose worker died."""
_RESTARTS = 100
"""How often Ray starts a worker again that dies."""
_THREADS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")
_LIBRARIES = ("torch", "numpy", "opencv-python-headless")


class RayWorkers(NamedTuple):
    """The workers that a command asks for."""

    address: str
    """Address of the cluster, or LOCAL."""
    device: str
    """Kind of device that every worker computes on: cpu or cuda."""
    indices: tuple[int, ...]
    """Which GPUs of this machine; empty for all."""

    @property
    def each(self) -> str:
        """What a worker has, in words."""
        return "one GPU" if self.device == "cuda" else "one CPU core"


def ray_workers_of(device: str, ray: str | None) -> RayWorkers | None:
    """Returns the workers asked for; None for this process alone.

    Args:
        device: Device as the user names it: one, several with commas, or "all".
        ray: Address of the cluster, or LOCAL. None: none is asked for.

    Raises:
        UsageError: The devices cannot be spread over.
    """
    names = device.split(",")
    if ray is None and len(names) == 1 and device != "all":
        return None
    kinds = {"cuda" if name == "all" else name.partition(":")[0] for name in names}
    kind = kinds.pop()
    if kinds or kind not in ("cpu", "cuda"):
        raise UsageError(f"device {device!r}: workers run on cpu, cuda, cuda:0,cuda:1 or all")
    indices = tuple(int(name[5:]) for name in names if name[5:].isdecimal() and kind == "cuda")
    if len(names) > 1 and len(set(indices)) < len(names):
        raise UsageError(f"device {device!r}: name each GPU once, such as cuda:0,cuda:1")
    address = ray or LOCAL
    if indices and address != LOCAL:
        raise UsageError(
            f"device {device!r}: GPUs of a cluster have no numbers; take --device cuda"
        )
    return RayWorkers(address, kind, indices)


class Worker:
    """Refines frames in a process of the cluster; a Ray actor."""

    def __init__(
        self,
        records: Records,
        deciding: Sequence[FrameFiles],
        shown: FrameFiles,
        versions: Mapping[str, str],
        shared: Sequence[Path],
        folder: Path,
        max_pixels: int | None,
        threads: int,
    ) -> None:
        for name in _THREADS:  # before torch and OpenCV are imported
            os.environ[name] = str(threads)
        with suppress(OSError):  # `ready` reports what cannot be seen
            os.chdir(folder)  # which relative paths start from
        import cv2
        import torch

        torch.set_num_threads(threads)
        cv2.setNumThreads(threads)
        set_max_pixels(max_pixels)
        self._records, self._deciding, self._shown = records, deciding, shown
        self._versions, self._shared = versions, shared
        self._open = ExitStack()  # until the process ends
        self._method: Method | None = None
        self._notes: list[str] = []

    def ready(self) -> None:
        """Raises ClusterError if this node differs from the driver's."""
        check_node(self._versions, self._shared)

    def refine(
        self, frames: Sequence[FrameFiles], settings_worked: bool
    ) -> tuple[list[FrameRecord], list[str]]:
        """Returns the records of the frames, and notes, after their results are written."""
        from pnpdepth_cli.commands.batch.running import open_method, refine_frames

        own = self._records
        if self._method is None:
            opened = open_method(own.request, self._deciding, self._shown, self._notes.append)
            self._method = self._open.enter_context(opened)
        records = list(refine_frames(frames, self._method, own, settings_worked=settings_worked))
        notes, self._notes = self._notes, []
        return records, notes


def software() -> dict[str, str]:
    """Returns the versions that have to be equal on all nodes; imports none of the libraries."""
    libraries = {name: metadata.version(name) for name in _LIBRARIES}
    return {"pnpdepth": __version__, "python": platform.python_version(), **libraries}


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


def refine_on_workers(
    workers: RayWorkers,
    deciding: Sequence[FrameFiles],
    to_do: Sequence[FrameFiles],
    records: Records,
    *,
    settings_worked: bool,
    say: Callable[[str], None],
    stopped: Callable[[], bool],
) -> Iterator[FrameRecord]:
    """Refines and writes the frames on Ray workers; yields the records as they are done.

    Arguments and errors are those of `refine_frames` and `open_method`, with ClusterError if the
    cluster cannot be used.
    """
    request = records.request
    locks = [path.absolute() for path in request.output.glob(LOCKS)]
    with connect_workers(workers) as (ray, count, resources):
        say(f"Ray workers: starting {count:,}, each with {workers.each}")
        options = {"scheduling_strategy": "SPREAD", "max_restarts": _RESTARTS, **resources}
        actor, shared = ray.remote(Worker).options(**options), [request.source, *locks]
        job = records, deciding, to_do[0], software(), shared, Path.cwd(), max_pixels_given()
        actors = [actor.remote(*job, resources["num_cpus"]) for _ in range(count)]
        try:
            yield from refine_on_actors(
                ray, actors, to_do, worked=settings_worked,
                lost=lambda frame, why: records.fail(request_of(request, frame), why), say=say,
                stopped=stopped,
            )  # fmt: skip
        finally:
            for started in actors:
                ray.kill(started)
    if request.shard is None:
        remove_all_leftovers(request.output)  # of workers that died


def refine_on_actors(
    ray: Any,
    actors: Sequence[Any],
    to_do: Sequence[FrameFiles],
    *,
    worked: bool,
    lost: Callable[[FrameFiles, str], FrameRecord],
    say: Callable[[str], None],
    stopped: Callable[[], bool],
) -> Iterator[FrameRecord]:
    """Hands out frames, a call at a time for each worker; yields the records as they are done.

    Until a frame is refined, only one worker gets any, as an error of the settings ends the batch
    then. The frames of a worker that dies go to any worker again, one by one, and each `_RETRIES`
    times; then `lost` gives its record from the frame and the reason. `worked` says whether
    a frame was refined with these settings before.
    """
    size = max(1, min(_FRAMES_OF_A_CALL, len(to_do) // (4 * len(actors))))
    waiting = deque((to_do[i : i + size], 0) for i in range(0, len(to_do), size))
    # The actor, the frames (none: it starts) and their deaths of each call.
    idle, running = list[Any](), dict[Any, tuple[Any, Sequence[FrameFiles], int]]()
    said = set[str]()

    def start(actor: Any) -> None:
        running[actor.ready.options(max_task_retries=-1).remote()] = actor, (), 0

    for actor in actors:
        start(actor)
    while True:
        # The next call, if there is one.
        over, busy = stopped() or not waiting, any(frames for _, frames, _ in running.values())
        if idle and not over and (worked or not busy):
            (frames, deaths), actor = waiting.popleft(), idle.pop()
            running[actor.refine.remote(frames, worked)] = actor, frames, deaths
            continue
        if over and not busy:
            return
        # The end of any call.
        ended, _ = ray.wait(list(running), timeout=None if busy else _NO_WORKER_S)
        if not ended:
            raise ClusterError(
                f"no worker has started for {_NO_WORKER_S:.0f} s; check the cluster with `ray"
                " status`, and run the same command to continue"
            )
        actor, frames, deaths = running.pop(ended[0])
        try:
            records, notes = ray.get(ended[0]) or ([], [])
        except ray.exceptions.RayTaskError as error:
            raise error.cause if isinstance(error.cause, Exception) else error from None
        except ray.exceptions.RayError as error:
            # A worker died.
            reason, deaths = reason_of(error), deaths + (len(frames) == 1)
            if not frames:
                raise ClusterError(f"a worker died {_RESTARTS} times: {reason}") from None
            say(f"warning: a worker died ({reason}); Ray starts another one")
            start(actor)
            if deaths > _RETRIES:
                yield lost(frames[0], f"its worker died {deaths} times: {reason}")
            else:
                waiting.extend(([frame], deaths) for frame in frames)
            continue
        idle.append(actor)
        for note in dict.fromkeys(notes):
            if note not in said:
                say(note)
        said |= {*notes}
        worked |= any(record.status != "failed" for record in records)
        yield from records


def reason_of(error: Exception) -> str:
    """Returns what Ray says of a worker's death, one line of many."""
    first, *others = str(error).strip().splitlines() or ["no reason is known"]
    in_creation = "error raised in its creation task" in first
    return (others[-1] if others and in_creation else first)[:200]


@contextmanager
def connect_workers(workers: RayWorkers) -> Iterator[tuple[ModuleType, int, dict[str, Any]]]:
    """Yields Ray, connected, the number of workers to start, and the resources of each.

    Raises:
        UsageError: Ray is not installed.
        ClusterError: The cluster cannot be reached, or has fewer devices than asked for.
    """
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"  # read when Ray is imported and by its processes
    try:
        import ray
    except ImportError:
        raise UsageError("--ray needs Ray: pip install 'pnpdepth[ray]'") from None
    _connect(ray, workers)
    try:
        yield ray, *_plan(ray, workers)
    finally:
        ray.shutdown()


def _connect(ray: ModuleType, workers: RayWorkers) -> None:
    address, local = workers.address, {}
    if address == LOCAL:
        if workers.indices:  # the cluster has these GPUs of the machine
            visible = os.environ.get("CUDA_VISIBLE_DEVICES")
            names = [] if visible is None else visible.split(",")
            chosen = [names[i] if i < len(names) else str(i) for i in workers.indices]
            os.environ["CUDA_VISIBLE_DEVICES"] = ",".join(chosen)
        local = {"include_dashboard": False, "object_store_memory": 100 * 2**20}  # records only
    try:
        if address not in (LOCAL, "auto"):  # Ray takes minutes to find out that nothing answers
            host, _, port = address.removeprefix("ray://").rpartition(":")
            socket.create_connection((host, int(port)), timeout=_CONNECT_S).close()
        ray.init(address=address, log_to_driver=False, logging_level="ERROR", **local)
    except (Exception, SystemExit) as error:
        reason = one_line(getattr(error, "strerror", None) or error).split(". ")[0][:200]
        raise ClusterError(
            f"Ray cluster {address!r} cannot be used: {reason}; check the address, start it with"
            " `ray start --head`, or leave the address out"
        ) from None


def _plan(ray: ModuleType, workers: RayWorkers) -> tuple[int, dict[str, Any]]:
    """The number of workers that the devices of the cluster allow, and the resources of each."""
    nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
    kind, resources = ("GPU" if workers.device == "cuda" else "CPU"), {"num_cpus": 1}
    there = sum(int(node.get(kind, 0)) for node in nodes)
    if workers.device == "cuda":  # the workers of a machine share its cores
        shares = [node.get("CPU", 1) // node["GPU"] for node in nodes if node.get("GPU", 0) >= 1]
        resources = {"num_cpus": max(1, int(min(shares, default=1))), "num_gpus": 1}
    wanted = len(workers.indices) or there
    if wanted > there or not there:
        where = "this machine" if workers.address == LOCAL else f"Ray cluster {workers.address!r}"
        raise ClusterError(
            f"{where} has devices for {there} Ray workers with {workers.each} each, and"
            f" {max(1, wanted)} asked for; change --device"
        )
    return wanted, resources
