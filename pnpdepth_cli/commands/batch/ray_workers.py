"""A batch on a Ray cluster, whose actors refine a few frames a call."""

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
from pnpdepth_cli.commands.batch.batch_request import LOCAL
from pnpdepth_cli.commands.batch.find_frames import request_of
from pnpdepth_cli.commands.batch.records import Records
from pnpdepth_cli.commands.batch.running import open_method, refine_frames
from pnpdepth_cli.dataset.frame_files import FrameFiles
from pnpdepth_cli.dataset.frame_record import FrameRecord
from pnpdepth_cli.errors import DeviceError, UsageError
from pnpdepth_cli.frames.method import Method
from pnpdepth_cli.io.file_bytes import one_line

_CONNECT_S = 5.0
_FRAMES_OF_A_CALL = 8
"""Frames that are read and written beside the network; fewer where that leaves workers idle."""
_TRIES = 3
"""How often a frame is tried whose worker dies."""
_DEATHS = 2 * _TRIES
"""So many deaths before any frame is refined end the batch."""


@dataclass(kw_only=True)
class Worker:
    """Refines frames in a process of the cluster; a Ray actor."""

    records: Records
    deciding: Sequence[FrameFiles]
    """The frames that decide what is open for all."""
    folder: Path
    """The folder that relative paths start from."""
    max_pixels: int | None
    threads: int
    method: Method | None = None
    """The method, open until the process ends; None before the first call."""
    stack: ExitStack = field(default_factory=ExitStack)

    def refine(self, frames: Sequence[FrameFiles], worked: bool) -> list[FrameRecord]:
        """Returns the records of the frames after their results are written.

        Args:
            frames: The frames to refine.
            worked: Whether a frame was refined with these settings before.

        Raises:
            DeviceError: This node does not see the driver's files.
            PnpDepthError: As `refine_frames`.
        """
        if self.method is None:
            self._begin()
            opened = open_method(self.records.request, self.deciding)
            self.method = self.stack.enter_context(opened)
        return list(refine_frames(frames, self.method, self.records, settings_worked=worked))

    def _begin(self) -> None:
        """Makes the process like the driver's."""
        import cv2
        import torch

        request = self.records.request
        for path in (self.folder / request.source, self.folder / request.output):
            if not path.exists():
                node = socket.gethostname()
                raise DeviceError(f"node {node} does not see {path}; all nodes must share it")
        os.chdir(self.folder)
        torch.set_num_threads(self.threads)
        cv2.setNumThreads(self.threads)
        set_max_pixels(self.max_pixels)


def refine_on_workers(
    deciding: Sequence[FrameFiles],
    to_do: Sequence[FrameFiles],
    records: Records,
    *,
    worked: bool,
    say: Callable[[str], None],
    stopped: Callable[[], bool],
) -> Iterator[FrameRecord]:
    """Refines and writes frames on Ray workers; yields the records as they are done.

    A worker that dies is replaced, and its frames are tried again one by one, by any worker. The
    record of a frame that kills its workers says so.

    Args:
        deciding: The frames that decide what is open for all.
        to_do: The frames to refine.
        records: The results.
        worked: Whether a frame was refined with these settings before.
        say: Receives notes.
        stopped: True if no further frame is to be begun.

    Raises:
        DeviceError: The cluster cannot be used.
        PnpDepthError: What ends a batch in one process, such as a full disk.
    """
    with _connected(records.request.ray or LOCAL) as ray:
        count, start = _plan(ray, deciding, records)
        count = min(count, len(to_do))
        say(f"Ray: {count:,} workers")
        # The parts of a call, and how often their worker died. The first is a single frame.
        size = max(1, min(_FRAMES_OF_A_CALL, len(to_do) // (4 * count)))
        parts = [to_do[:1], *(to_do[i : i + size] for i in range(1, len(to_do), size))]
        waiting = deque((part, 0) for part in parts)
        idle, deaths = [start() for _ in range(count)], 0
        running = dict[Any, tuple[Any, Sequence[FrameFiles], int]]()
        while True:
            # Until a frame is refined, only one worker has a call, as its error may be of all.
            while idle and waiting and (worked or not running) and not stopped():
                worker, (part, tries) = idle.pop(), waiting.popleft()
                running[worker.refine.remote(part, worked)] = worker, part, tries
            if not running:
                return
            # Workers without a call end, and leave their device to those that have one.
            while idle and worked:
                ray.kill(idle.pop())
            # The end of any call.
            (ended, *_), _ = ray.wait([*running])
            worker, part, tries = running.pop(ended)
            try:
                done = ray.get(ended)
            except ray.exceptions.RayTaskError as error:
                raise error.cause from None
            except ray.exceptions.RayError as error:
                reason, deaths = one_line(error), deaths + 1
                if deaths == _DEATHS and not worked:
                    raise DeviceError(f"Ray workers die: {reason}") from None
                say(f"warning: a worker died ({reason})")
                worker, tries = start(), tries + (len(part) == 1)
                waiting.extend(([frame], tries) for frame in part if tries < _TRIES)
                why = f"its worker died {tries} times: {reason}"
                request = request_of(records.request, part[0])
                done = [records.fail(request, why)] if tries == _TRIES else []
            idle.append(worker)
            worked |= any(record.status != "failed" for record in done)
            yield from done


def _plan(
    ray: ModuleType, deciding: Sequence[FrameFiles], records: Records
) -> tuple[int, Callable[[], Any]]:
    """Returns the number of devices of the cluster, and a function that starts a worker on one."""
    # A GPU has its share of the cores; Ray has libraries use as many threads.
    network, total = records.request.refine.network, ray.cluster_resources()
    gpus = network.device == "cuda"
    devices = int(total.get("GPU" if gpus else "CPU", 0))
    if not devices:
        raise DeviceError(f"the Ray cluster has no device {network.device}; change --device")
    cores = max(1, int(total["CPU"] // devices)) if gpus else 1
    actor = ray.remote(Worker).options(
        num_cpus=cores, num_gpus=int(gpus), scheduling_strategy="SPREAD"
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
    """Yields Ray, connected. UsageError if it is not installed, DeviceError without a cluster."""
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
    except (Exception, SystemExit) as error:
        raise DeviceError(
            f"Ray cluster {address!r} cannot be used: {one_line(error)}; check the address, start"
            " it with `ray start --head`, or leave the address out"
        ) from None
    try:
        yield ray
    finally:
        ray.shutdown()
