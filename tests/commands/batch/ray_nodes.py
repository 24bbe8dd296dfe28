"""A Ray cluster of three nodes on loopback, for tests."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

CPUS = 1
_OBJECT_STORE_BYTES = 100 * 2**20


@contextmanager
def three_nodes() -> Iterator[Any]:
    """Yields a cluster of three nodes of one CPU each."""
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
    from ray.cluster_utils import Cluster

    node = {"num_cpus": CPUS, "object_store_memory": _OBJECT_STORE_BYTES}
    head = {**node, "node_ip_address": "127.0.0.2", "include_dashboard": False}
    cluster = Cluster(initialize_head=True, head_node_args=head)
    try:
        for number in (3, 4):
            cluster.add_node(**node, node_ip_address=f"127.0.0.{number}")
        yield cluster
    finally:
        cluster.shutdown()
