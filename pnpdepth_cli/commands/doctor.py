"""What `pnpdepth doctor` reports: versions, packages, devices, memory, and a refined frame."""

from __future__ import annotations

import platform
import re
import time
from collections.abc import Iterator
from importlib import metadata

import numpy as np
import psutil
import torch

from pnpdepth_cli.commands.shared.tables import count_of
from pnpdepth_cli.models import decisions
from pnpdepth_cli.models.network import load_network
from pnpdepth_cli.refiner import Refiner
from pnpdepth_cli.version import __version__

_DEVELOPERS = ("test", "docs", "train")
"""Extras that no command needs."""
_WRONG_M = 0.1
"""MAE of the plane of the self-test, of 2 to 4 m, from which on the depth is wrong."""


def examine(*, clear_cache: bool = False) -> dict[str, list[str]]:
    """Returns the lines of the report by topic.

    Args:
        clear_cache: Whether what was decided about networks in earlier runs is forgotten first.

    Raises:
        OutputError: The files of what was decided cannot be removed.
    """
    if clear_cache:
        decisions.forget()
    memory = psutil.virtual_memory()
    return {
        "pnpdepth": [__version__],
        "python": [f"{platform.python_version()}, {platform.system()} {platform.machine()}"],
        "packages": list(_packages()),
        "devices": _devices(),
        "memory": [f"{memory.available / 1e9:.1f} of {memory.total / 1e9:.1f} GB available"],
        "cache": [_cache()],
        "self-test": [_self_test()],
    }


def _packages() -> Iterator[str]:
    """Yields a text for each package that is required or of a user's extra, with its version."""
    # A line of the package's metadata is such as `rosbags>=0.10; extra == "ros"`.
    for line in metadata.requires("pnpdepth") or []:
        name = re.split(r"[^\w.-]", line)[0]
        extra = re.search(r"extra == ['\"]([\w-]+)", line)
        if extra is not None and extra[1] in _DEVELOPERS:
            continue
        try:
            version = metadata.version(name)
        except metadata.PackageNotFoundError:
            version = "not installed"
        yield f"{name} {version}" + (f", of the extra {extra[1]}" if extra else "")


def _devices() -> list[str]:
    """A text for the processor, and for each GPU of CUDA."""
    capability = torch.backends.cpu.get_cpu_capability()
    cpu = f"cpu: {torch.get_num_threads()} threads, {capability}"
    gpus = [
        f"cuda:{number}: {torch.cuda.get_device_name(number)}"
        for number in range(torch.cuda.device_count())
    ]
    return [cpu, *gpus]


def _cache() -> str:
    """How much is kept of what was decided about networks, for the next run."""
    files = decisions.kept_files()
    size = sum(path.stat().st_size for path in files)
    return f"decisions about {count_of(len(files), 'network')}, {size / 1000:.1f} kB"


def _self_test() -> str:
    """Refines a slanted plane with `compact`; returns whether it passed, the time and the error."""
    # A plane 2 to 4 m away, of whose pixels a hundredth is measured; its image shows the depth.
    y, x = np.mgrid[:96, :128]
    depth = (2 + x / 100 + y / 200).astype(np.float32)
    is_measured = np.random.default_rng(0).random(depth.shape) < 0.01
    rgb = np.repeat((depth * 50).astype(np.uint8)[..., None], 3, axis=2)
    # Its refinement, and the error.
    start = time.perf_counter()
    with Refiner(load_network("compact", None)) as refiner:
        refined = refiner.refine(rgb, depth * is_measured)
    seconds = time.perf_counter() - start
    error = float(np.abs(refined.depth - depth).mean())
    verdict = "passed" if error < _WRONG_M else "FAILED: the depth is wrong"
    return f"{verdict}; a plane refined in {seconds:.1f} s, MAE {error:.3f} m"
