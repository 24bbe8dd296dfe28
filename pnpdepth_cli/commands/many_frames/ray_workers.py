"""Refines the frames of a batch on the devices of a Ray cluster.

Each worker, a Ray actor, refines a few frames a call, as `in_process` does.
"""

from __future__ import annotations

import functools
import logging
import os
import socket
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any

from pnpdepth_cli.budget import max_pixels_given, set_max_pixels
from pnpdepth_cli.commands.many_frames.find_frames import request_of
from pnpdepth_cli.commands.many_frames.in_process import open_method, refine_frames
from pnpdepth_cli.commands.many_frames.records import Records
from pnpdepth_cli.commands.requests.batch_request import LOCAL, Listener
from pnpdepth_cli.dataset.frame_files import FrameFiles
from pnpdepth_cli.dataset.frame_record import FrameRecord
from pnpdepth_cli.errors import DeviceError, UsageError
from pnpdepth_cli.frames.method import Method
from pnpdepth_cli.io.file_bytes import one_line

_CONNECT_S = 5.0
"""Seconds for a cluster to answer."""
_FRAMES_OF_A_CALL = 8
"""Frames that are read and written beside the network; fewer where that leaves workers idle."""
_CALLS_OF_A_WORKER = 4
"""Calls that each worker gets if there are enough frames, so that none waits long for the last."""
_TRIES = 3
"""How often a frame is tried whose worker dies."""
_DEATHS = 2 * _TRIES
"""Deaths of workers, before any frame is refined, that end the batch."""


@dataclass(kw_only=True)
class Worker:
    """Refines frames in a process of the cluster; a Ray actor."""

    records: Records
    """Where the results and their records lie."""
    deciding: Sequence[FrameFiles]
    """A few frames on which it finds what neither user nor network states, as all workers do."""
    folder: Path
    """The folder that relative paths start from."""
    max_pixels: int | None
    """Pixels of the largest image that the user allows. None: the user states none."""
    threads: int
    """Number of threads with which torch and OpenCV compute."""
    stack: ExitStack = field(default_factory=ExitStack)
    """Holds the method open until the process ends."""

    def refine(self, frames: Sequence[FrameFiles], has_worked: bool) -> list[FrameRecord]:
        """Refines and writes frames; returns their records.

        Args:
            frames: The frames to refine.
            has_worked: Whether a frame was refined with these settings before.

        Raises:
            DeviceError: The process does not see the files.
            StorageError, ModelError, UsageError: An error of all frames.
        """
        return list(refine_frames(frames, self.method, self.records, has_worked))

    @functools.cached_property
    def method(self) -> Method | None:
        """The method of `open_method`, open until the process ends; None if no frame can be read.

        Before it is made, the process gets the folder, the limits and the threads of this worker.

        Raises:
            DeviceError: The process does not see the files.
        """
        import cv2
        import torch

        request = self.records.request
        for path in (self.folder / request.source, self.folder / request.output):
            if not path.exists():
                raise DeviceError(
                    f"node {socket.gethostname()} does not see {path}; all nodes must share it"
                )
        os.chdir(self.folder)
        torch.set_num_threads(self.threads)
        cv2.setNumThreads(self.threads)
        set_max_pixels(self.max_pixels)
        return self.stack.enter_context(open_method(request, self.deciding))


@dataclass(kw_only=True)
class _Call:
    """Frames that one worker refines, and how often a worker died of them."""

    frames: Sequence[FrameFiles]
    deaths: int = 0
    """How often, while the frame was alone in its call."""


def refine_on_workers(
    deciding: Sequence[FrameFiles],
    to_do: Sequence[FrameFiles],
    records: Records,
    has_worked: bool,
    listener: Listener,
) -> Iterator[FrameRecord]:
    """Refines and writes frames on Ray workers; yields each record when its frame is done.

    A worker that dies is replaced, and its frames are tried again one by one, by any worker.

    Args:
        deciding: A few frames on which every worker finds what neither user nor network states.
        to_do: The frames to refine.
        records: Where the results and their records lie.
        has_worked: Whether a frame was refined with these settings before.
        listener: Receives notes, and may stop the batch.

    Raises:
        UsageError: Ray is not installed.
        DeviceError: The cluster cannot be used, or its workers die.
        StorageError, ModelError, UsageError: An error of all frames.
    """
    with _connected(records.request.ray or LOCAL) as ray:
        devices, start = _plan(ray, deciding, records)
        count = min(devices, len(to_do))
        listener.say(f"Ray: {count:,} workers")
        workers = _Workers(
            ray=ray,
            start=start,
            records=records,
            listener=listener,
            has_worked=has_worked,
            waiting=deque(_calls(to_do, count)),
            idle=[start() for _ in range(count)],
        )
        while workers.hand_out():
            yield from workers.next_records()


@dataclass(kw_only=True)
class _Workers:
    """The workers of a cluster, the calls that they run, and those that wait."""

    ray: ModuleType
    """The package Ray, connected to the cluster."""
    start: Callable[[], Any]
    """Starts a worker, a Ray actor."""
    records: Records
    """Where the results and their records lie."""
    listener: Listener
    """Receives notes, and may stop the batch."""
    has_worked: bool
    """Whether a frame was refined, so that no error of another is of all."""
    waiting: deque[_Call]
    """Calls that no worker has yet."""
    idle: list[Any]
    """Workers that have no call."""
    running: dict[Any, tuple[Any, _Call]] = field(default_factory=dict)
    """The worker and the call of each result that Ray will have."""
    deaths: int = 0
    """How many workers died."""

    def hand_out(self) -> bool:
        """Gives calls that wait to idle workers. Returns whether any worker has a call.

        If none has, the batch is done or stopped.
        """
        # Until a frame is refined, an error may concern all frames, so only one worker has a call.
        while self.idle and self.waiting and (self.has_worked or not self.running):
            if self.listener.stopped():
                break
            worker = self.idle.pop()
            call = self.waiting.popleft()
            self.running[worker.refine.remote(call.frames, self.has_worked)] = worker, call
        if not self.running:
            return False
        # Workers without a call end, and leave their device to those that have one.
        while self.idle and self.has_worked:
            self.ray.kill(self.idle.pop())
        return True

    def next_records(self) -> list[FrameRecord]:
        """Waits for the end of any call, and returns the records of its frames.

        Raises:
            DeviceError: Workers die before any frame is refined.
            Exception: What the call raised, which is of all frames.
        """
        ended_results, _ = self.ray.wait([*self.running])
        result = ended_results[0]
        worker, call = self.running.pop(result)
        try:
            done: list[FrameRecord] = self.ray.get(result)
        # The call raised; Ray's own error hides what it was.
        except self.ray.exceptions.RayTaskError as error:
            raise error.cause from None
        # The worker died: another one takes its place, and its frames wait again.
        except self.ray.exceptions.RayError as error:
            reason = one_line(error)
            self.deaths += 1
            if self.deaths == _DEATHS and not self.has_worked:
                raise DeviceError(f"Ray workers die: {reason}") from None
            self.listener.say(f"warning: a worker died ({reason})")
            worker = self.start()
            again, done = _after_death(call, self.records, reason)
            self.waiting.extend(again)
        self.idle.append(worker)
        self.has_worked |= any(record.status != "failed" for record in done)
        return done


def _calls(to_do: Sequence[FrameFiles], workers: int) -> Iterator[_Call]:
    """Yields calls of a few frames each; the first has one, which shows if the network works.

    Args:
        to_do: The frames to refine.
        workers: Number of workers, each of which is to have several calls if there are enough.
    """
    size = max(1, min(_FRAMES_OF_A_CALL, len(to_do) // (_CALLS_OF_A_WORKER * workers)))
    yield _Call(frames=to_do[:1])
    for first in range(1, len(to_do), size):
        yield _Call(frames=to_do[first : first + size])


def _after_death(
    call: _Call, records: Records, reason: str
) -> tuple[list[_Call], list[FrameRecord]]:
    """The calls that follow when a worker died, and the record of a frame that is given up.

    Only a frame that was alone in its call is known to be what the worker died of.

    Args:
        call: The call that the worker had.
        records: Where the record of a frame that is given up is written.
        reason: What Ray says of the death, one line.
    """
    deaths = call.deaths + 1 if len(call.frames) == 1 else call.deaths
    if deaths < _TRIES:
        return [_Call(frames=[frame], deaths=deaths) for frame in call.frames], []
    error = DeviceError(f"its worker died {deaths} times: {reason}")
    return [], [records.fail(request_of(records.request, call.frames[0]), error)]


def _plan(
    ray: ModuleType, deciding: Sequence[FrameFiles], records: Records
) -> tuple[int, Callable[[], Any]]:
    """Returns the number of devices of the cluster, and a function that starts a worker on one.

    Args:
        ray: The package Ray, connected to the cluster.
        deciding: A few frames on which every worker finds what neither user nor network states.
        records: Where the results and their records lie.

    Raises:
        DeviceError: The cluster has no such device.
    """
    # A device is a GPU with its share of the cores, or a core; Ray has libraries use as many
    # threads as a worker has cores.
    device = records.request.refine.device
    resources = ray.cluster_resources()
    on_gpus = device == "cuda"
    devices = int(resources.get("GPU" if on_gpus else "CPU", 0))
    if not devices:
        raise DeviceError(f"the Ray cluster has no device {device}; change --device")
    cores = max(1, int(resources["CPU"] // devices)) if on_gpus else 1
    actor = ray.remote(Worker).options(
        num_cpus=cores, num_gpus=int(on_gpus), scheduling_strategy="SPREAD"
    )
    # All workers have the same job.
    return devices, functools.partial(
        actor.remote,
        records=records,
        deciding=deciding,
        folder=Path.cwd(),
        max_pixels=max_pixels_given(),
        threads=cores,
    )


@contextmanager
def _connected(address: str) -> Iterator[ModuleType]:
    """Yields the package Ray, connected to a cluster until the end of the block.

    Args:
        address: Address of the cluster, as `parse_address` takes it.

    Raises:
        UsageError: Ray is not installed.
        DeviceError: The cluster cannot be used.
    """
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"  # read when Ray is imported and by its processes
    try:
        import ray
    except ImportError:
        raise UsageError("--ray needs Ray: pip install 'pnpdepth[ray]'") from None
    try:
        if address not in (LOCAL, "auto"):  # Ray takes minutes to find out that nothing answers
            host, _, port = address.removeprefix("ray://").rpartition(":")
            socket.create_connection((host, int(port)), timeout=_CONNECT_S).close()
        ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR)
    # Ray raises errors of many kinds here, SystemExit among them.
    except (Exception, SystemExit) as error:
        raise DeviceError(
            f"Ray cluster {address!r} cannot be used: {one_line(error)}; check the address, start"
            " it with `ray start --head`, or leave the address out"
        ) from None
    try:
        yield ray
    finally:
        ray.shutdown()
