"""The process on a node of the cluster that does pieces of a job. Imports no Ray."""

from __future__ import annotations

import os
import platform
import socket
import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, ExitStack, suppress
from dataclasses import dataclass, field, replace
from importlib import metadata
from pathlib import Path
from typing import Any, Protocol

from pnpdepth_cli import __version__
from pnpdepth_cli.budget import set_max_pixels

_THREADS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")
_LIBRARIES = ("torch", "numpy", "opencv-python-headless")


@dataclass(frozen=True, kw_only=True)
class Start:
    """What a worker is started with."""

    folder: str
    """The driver's working folder, which relative paths start from."""
    shared: tuple[Path, ...]
    """Files and folders that every worker has to see."""
    threads: int
    """Threads of torch, OpenCV and OpenMP."""
    max_pixels: int | None
    """Of `--max-pixels`."""


@dataclass(frozen=True, kw_only=True)
class Facts:
    """What a worker says of itself."""

    node: str
    """Name of its machine."""
    pid: int
    """Its process number."""
    versions: dict[str, str]
    """Of the program, Python and the numerical libraries."""
    unseen: tuple[Path, ...]
    """Those of the shared files and folders that are not there."""


@dataclass(frozen=True, kw_only=True)
class Done:
    """What a worker has done in a call."""

    results: Sequence[Any]
    """Of the next items in the order in which they came, with those of pieces before."""
    seconds: float = 0.0
    """How long it took, which the worker measures."""
    proves: bool = True
    """Whether the settings are good, so that later errors are of single items."""
    multiple: int = 1
    """Items that are best handed out together."""
    notes: Sequence[str] = ()
    """Notes and warnings."""
    figures: dict[str, Any] = field(default_factory=dict)
    """Of all pieces of this worker up to now."""


Work = Callable[[Sequence[Any], bool, bool], Done]
"""A function of a piece's items, whether others succeeded, and whether all results are wanted now.

Where they are not, items may be finished in later calls.
"""


class Job(Protocol):
    """Work on items; it is pickled and sent to each worker once."""

    def opened(self) -> AbstractContextManager[Work]:
        """Returns, for `with`, what does a piece."""


class Worker:
    """Does pieces of one job after the other.

    Args:
        start: How.
    """

    def __init__(self, start: Start) -> None:
        for name in _THREADS:  # before torch and OpenCV are imported
            os.environ[name] = str(start.threads)
        os.environ.setdefault("GOMP_SPINCOUNT", "3000")
        with suppress(OSError):  # what is shared tells
            os.chdir(start.folder)
        import cv2
        import torch

        torch.set_num_threads(start.threads)
        cv2.setNumThreads(start.threads)
        set_max_pixels(start.max_pixels)
        self._shared = start.shared
        self._open = ExitStack()
        self._work: Work | None = None

    def facts(self) -> Facts:
        """Returns what has to be equal on all nodes."""
        return Facts(
            node=socket.gethostname(),
            pid=os.getpid(),
            versions=software(),
            unseen=tuple(path for path in self._shared if not path.exists()),
        )

    def call(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """Returns what the function returns here."""
        return function(*arguments)

    def open(self, job: Job) -> None:
        """Ends the job before, and opens this one."""
        self._open.close()
        self._work = self._open.enter_context(job.opened())

    def close(self) -> None:
        """Ends the job."""
        self._open.close()

    def run(self, items: Sequence[Any], checked: bool, finish: bool) -> Done:
        """Does a piece of the job; `finish` also all that is left of those before."""
        assert self._work is not None
        began = time.perf_counter()
        done = self._work(items, checked, finish)
        return replace(done, seconds=time.perf_counter() - began)


def software() -> dict[str, str]:
    """Returns the versions that have to be equal on all nodes; imports none of the libraries."""
    return {
        "pnpdepth": __version__,
        "python": platform.python_version(),
        **{name: metadata.version(name) for name in _LIBRARIES},
    }
