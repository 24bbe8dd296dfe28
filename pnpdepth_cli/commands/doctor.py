"""What `pnpdepth doctor` reports: versions, devices, memory, extras, and a refined frame."""

from __future__ import annotations

import platform
import re
import time
from importlib import metadata

import numpy as np
import psutil
import torch

import pnpdepth_cli

_REQUIREMENT = re.compile(r"^([\w.-]+).*extra == ['\"]([\w-]+)['\"]")
_DEVELOPERS = ("test", "docs", "train")
"""Extras that no command needs."""


def examine() -> dict[str, str | list[str]]:
    """Returns the report, a line or several by topic.

    Raises:
        PnpDepthError: The small frame cannot be refined.
    """
    required, extras = _requirements()
    memory = psutil.virtual_memory()
    return {
        "pnpdepth": pnpdepth_cli.__version__,
        "python": f"{platform.python_version()}, {platform.system()} {platform.machine()}",
        "packages": [f"{name} {_version(name) or 'not installed'}" for name in required],
        "extras": [f"{extra}: {_state(names)}" for extra, names in extras.items()],
        "devices": _devices(),
        "memory": f"{memory.available / 1e9:.1f} of {memory.total / 1e9:.1f} GB available",
        "self-test": _self_test(),
    }


def _requirements() -> tuple[list[str], dict[str, list[str]]]:
    """Names of the required packages, and of the packages of each extra."""
    required, extras = [], dict[str, list[str]]()
    for line in metadata.requires("pnpdepth") or []:
        match = _REQUIREMENT.match(line)
        if match is None:
            required.append(re.split(r"[^\w.-]", line)[0])
        elif match[2] not in _DEVELOPERS:
            extras.setdefault(match[2], []).append(match[1])
    return required, extras


def _version(package: str) -> str:
    """Returns the installed version; empty if there is none."""
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return ""


def _state(packages: list[str]) -> str:
    missing = [name for name in packages if not _version(name)]
    if missing:
        return f"not installed ({', '.join(missing)})"
    return ", ".join(f"{name} {_version(name)}" for name in packages)


def _devices() -> list[str]:
    capability = torch.backends.cpu.get_cpu_capability()
    cpu = f"cpu: {torch.get_num_threads()} threads, {capability}"
    numbers = range(torch.cuda.device_count())
    return [cpu, *(f"cuda:{n}: {torch.cuda.get_device_name(n)}" for n in numbers)]


def _self_test() -> str:
    """Refines a slanted plane with `compact`. Returns what came out."""
    y, x = np.mgrid[:96, :128]
    depth = (2 + x / 100 + y / 200).astype(np.float32)
    known = np.random.default_rng(0).random(depth.shape) < 0.01
    rgb = np.repeat((depth * 50).astype(np.uint8)[..., None], 3, axis=2)
    start = time.perf_counter()
    refined = pnpdepth_cli.refine(pnpdepth_cli.load_network("compact"), rgb, depth * known)
    seconds, error = time.perf_counter() - start, float(np.abs(refined.depth - depth).mean())
    verdict = "passed" if error < 0.1 else "FAILED: the depth is wrong"
    return f"{verdict}; a plane refined in {seconds:.1f} s, MAE {error:.3f} m"
