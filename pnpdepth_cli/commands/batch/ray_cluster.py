"""Connects to a Ray cluster, or starts one of this machine's devices."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from types import ModuleType
from typing import Any, NamedTuple

from pnpdepth_cli.commands.batch.request import LOCAL, RayWorkers
from pnpdepth_cli.errors import ClusterError, UsageError
from pnpdepth_cli.io.file_bytes import one_line

_CONNECT_S = 5.0
_OBJECT_STORE_BYTES = 100 * 2**20
"""Of a local cluster: only rows of frames go through it."""


class Cluster(NamedTuple):
    """A connection to a cluster."""

    ray: ModuleType
    """Ray, connected."""
    workers: int
    """Number of workers to start."""
    resources: dict[str, Any]
    """Of each worker, as Ray's options."""


@contextmanager
def connected(workers: RayWorkers) -> Iterator[Cluster]:
    """Yields a connection to the cluster; a local one ends with it.

    Raises:
        UsageError: Ray is not installed.
        ClusterError: The cluster cannot be reached, or has fewer devices than asked for.
    """
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"  # read when Ray is imported and by its processes
    try:
        import ray
    except ImportError:
        raise UsageError("--ray needs Ray: pip install 'pnpdepth[ray]'") from None
    ours = not ray.is_initialized()
    if ours:
        _connect(ray, workers)
    try:
        yield _planned(ray, workers)
    finally:
        if ours:
            ray.shutdown()


def _connect(ray: ModuleType, workers: RayWorkers) -> None:
    address, local = workers.address, {}
    if address == LOCAL:
        _choose_gpus(workers.indices)
        local = {
            "num_cpus": os.cpu_count(),
            "include_dashboard": False,
            "object_store_memory": _OBJECT_STORE_BYTES,
        }
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


def _choose_gpus(indices: tuple[int, ...]) -> None:
    """Makes these GPUs of the machine the cluster's."""
    if indices:
        visible = os.environ.get("CUDA_VISIBLE_DEVICES")
        names = [] if visible is None else visible.split(",")
        chosen = [names[i] if i < len(names) else str(i) for i in indices]
        os.environ["CUDA_VISIBLE_DEVICES"] = ",".join(chosen)


def _planned(ray: ModuleType, workers: RayWorkers) -> Cluster:
    """The workers that the devices of the cluster allow."""
    options, resources = workers.options, {"num_cpus": workers.options.cpus_per_worker}
    if workers.device == "cuda":
        there = int(ray.cluster_resources().get("GPU", 0))
        resources["num_gpus"] = 1
    else:
        nodes = [node["Resources"].get("CPU", 0) for node in ray.nodes() if node["Alive"]]
        there = sum(int(count) // options.cpus_per_worker for count in nodes)
    wanted = options.ray_workers or len(workers.indices) or there
    if wanted > there or not there:
        where = "this machine" if workers.address == LOCAL else f"Ray cluster {workers.address!r}"
        raise ClusterError(
            f"{where} has devices for {there} Ray workers with {workers.each} each, and"
            f" {max(1, wanted)} asked for; change --device, --ray-workers or --cpus-per-worker"
        )
    return Cluster(ray, wanted, resources)
