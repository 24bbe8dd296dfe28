from __future__ import annotations

import socket
import sys

import pytest
from pnpdepth_cli.commands.batch.ray_cluster import connected

from pnpdepth_cli.commands.batch.request import (
    LOCAL,
    ClusterOptions,
    parse_address,
    ray_workers_of,
)
from pnpdepth_cli.errors import ClusterError, UsageError


def connect(address: str) -> None:
    workers = ray_workers_of("cpu", ClusterOptions(ray=address))
    assert workers is not None
    with connected(workers):
        raise AssertionError("there is no cluster")


def test_without_ray_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(UsageError, match=r"--ray needs Ray: pip install 'pnpdepth\[ray\]'"):
        connect(LOCAL)


@pytest.mark.parametrize("scheme", ["", "ray://"])
def test_an_address_where_nothing_answers_is_an_error_at_once(scheme: str) -> None:
    pytest.importorskip("ray")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
        with pytest.raises(ClusterError, match=r"cannot be used: Connection refused; check the"):
            connect(f"{scheme}127.0.0.1:{port}")


@pytest.mark.parametrize("text", ["frames/", "out", "host", "ray://host", "a/b:1"])
def test_a_folder_after_ray_is_not_taken_for_an_address(text: str) -> None:
    with pytest.raises(UsageError, match="is no address of a Ray cluster"):
        parse_address(text)


@pytest.mark.parametrize("text", ["auto", "local", "host:6379", "ray://host:10001", "[::1]:6379"])
def test_addresses_of_clusters(text: str) -> None:
    assert parse_address(text) == text


def test_one_device_needs_no_cluster() -> None:
    assert ray_workers_of("cuda:1", ClusterOptions()) is None
    with pytest.raises(UsageError, match="are of Ray workers; add --ray"):
        ray_workers_of("cuda:1", ClusterOptions(ray_workers=2))


def test_several_devices_are_a_local_cluster() -> None:
    workers = ray_workers_of("cuda:0,cuda:2", ClusterOptions())
    assert workers is not None
    assert (workers.address, workers.device, workers.indices) == (LOCAL, "cuda", (0, 2))
    workers = ray_workers_of("all", ClusterOptions())
    assert workers is not None
    assert (workers.address, workers.device, workers.indices) == (LOCAL, "cuda", ())


@pytest.mark.parametrize(
    "device", ["cuda:0,cuda:0", "cpu,cuda:0", "cpu,cpu", "mps,mps", "cuda,cuda"]
)
def test_devices_that_cannot_be_spread_over_are_refused(device: str) -> None:
    with pytest.raises(UsageError, match=f"device '{device}'"):
        ray_workers_of(device, ClusterOptions())


def test_gpus_of_a_cluster_have_no_numbers() -> None:
    with pytest.raises(UsageError, match="take --device cuda, and --ray-workers 2"):
        ray_workers_of("cuda:0,cuda:1", ClusterOptions(ray="auto"))
