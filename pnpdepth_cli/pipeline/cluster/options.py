"""What the user asks of a Ray cluster. Imports neither Ray nor torch."""

from __future__ import annotations

import re
from dataclasses import dataclass

from pnpdepth_cli.errors import UsageError
from pnpdepth_cli.settings import option

LOCAL = "local"
"""The address of a cluster of this machine's devices, which ends with the command."""
ALL_DEVICES = "all"
_ADDRESS = re.compile(r"(ray://)?[^/]+:\d+")


def parse_address(text: str) -> str:
    """Returns the address of a cluster. Raises UsageError for a text that is none."""
    if text in (LOCAL, "auto") or _ADDRESS.fullmatch(text):
        return text
    raise UsageError(
        f"{text!r} is no address of a Ray cluster; give --ray=auto, --ray=HOST:PORT, or --ray as"
        " the last option for this machine"
    )


@dataclass(frozen=True, kw_only=True)
class ClusterOptions:
    """Where frames are computed, if not in this process."""

    ray: str | None = option(
        None,
        "Run on a Ray cluster: auto, HOST:PORT or ray://HOST:PORT. Without an address, on all"
        " devices of this machine. Needs the extra ray.",
        metavar="[ADDRESS]",
        parse=parse_address,
        value_if_bare=LOCAL,
    )
    ray_workers: int | None = option(
        None,
        "Number of Ray workers.  [default: one per GPU, or per --cpus-per-worker cores]",
        metavar="N",
        least=1,
    )
    cpus_per_worker: int = option(
        1, "CPU cores, and threads, of a Ray worker.", metavar="N", least=1, show_default=True
    )
    retries: int = option(
        2,
        "How often a frame is tried again whose Ray worker died.",
        metavar="N",
        least=0,
        show_default=True,
    )


@dataclass(frozen=True, kw_only=True)
class RayWorkers:
    """The workers that a command asks for."""

    address: str
    """Of the cluster, or LOCAL."""
    device: str
    """Kind of device that every worker computes on: cpu or cuda."""
    indices: tuple[int, ...] = ()
    """Which GPUs of this machine; empty for all."""
    options: ClusterOptions
    """The user's."""

    @property
    def each(self) -> str:
        """What a worker has, in words."""
        cpus = self.options.cpus_per_worker
        return "one GPU" if self.device == "cuda" else f"{cpus} CPU core{'s' if cpus > 1 else ''}"


def ray_workers_of(device: str, options: ClusterOptions) -> RayWorkers | None:
    """Returns the workers asked for; None for this process alone.

    Args:
        device: As the user names it: one device, several with commas, or "all".
        options: Of the cluster.

    Raises:
        UsageError: The devices cannot be spread over.
    """
    names = device.split(",")
    if options.ray is None and len(names) == 1 and device != ALL_DEVICES:
        if options != ClusterOptions():
            raise UsageError(
                "--ray-workers, --cpus-per-worker and --retries are of Ray workers; add --ray"
            )
        return None
    kinds = {"cuda" if name == ALL_DEVICES else name.partition(":")[0] for name in names}
    kind = kinds.pop()
    if kinds or kind not in ("cpu", "cuda"):
        raise UsageError(f"device {device!r}: workers run on cpu, cuda, cuda:0,cuda:1 or all")
    indices = tuple(int(name[5:]) for name in names if name[5:].isdecimal() and kind == "cuda")
    if len(names) > 1 and len(set(indices)) < len(names):
        raise UsageError(f"device {device!r}: name each GPU once, such as cuda:0,cuda:1")
    address = options.ray or LOCAL
    if indices and address != LOCAL:
        raise UsageError(
            f"device {device!r}: GPUs of a cluster have no numbers; take --device cuda, and"
            f" --ray-workers {len(indices)}"
        )
    return RayWorkers(address=address, device=kind, indices=indices, options=options)
