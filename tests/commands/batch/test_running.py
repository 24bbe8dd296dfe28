"""Batches on a real Ray cluster of three nodes; the frames that decide what is left open."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pnpdepth_cli.commands.batch.batch_request import parse_address
from pnpdepth_cli.commands.batch.running import spread
from pnpdepth_cli.dataset.frame_record import FrameRecord
from pnpdepth_cli.errors import DeviceError, ModelError, UsageError
from pnpdepth_cli.frames.resolve import NORMALISATIONS
from pnpdepth_cli.io.atomic import remove_leftovers
from tests.commands.batches import RecordingListener, add_frame, batch, pairs_on_disk, results

NAMES = tuple(f"f{number:02}" for number in range(12))
DEADLY = "        if float(rgb.mean()) > 0.99:\n            import os\n            os._exit(1)\n"


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    """Three nodes of one CPU each, which are addresses of loopback."""
    if sys.platform != "linux":
        pytest.skip("nodes are loopback addresses")
    pytest.importorskip("ray")
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
    from ray.cluster_utils import Cluster

    node = {"num_cpus": 1, "object_store_memory": 100 * 2**20}
    head = node | {"node_ip_address": "127.0.0.2", "include_dashboard": False}
    nodes = Cluster(initialize_head=True, head_node_args=head)
    for number in (3, 4):
        nodes.add_node(**node, node_ip_address=f"127.0.0.{number}")
    yield nodes
    nodes.shutdown()


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return pairs_on_disk(tmp_path / "drive", NAMES)


@pytest.mark.slow
def test_results_equal_those_of_one_process_when_a_node_is_lost(cluster: Any, root: Path) -> None:
    lost = cluster.worker_nodes.copy().pop()

    def lose() -> None:
        if len(listener.records) == 2:
            cluster.remove_node(lost, allow_graceful=False)

    listener = RecordingListener(on_frame=lose)
    result = batch(root, listener, ray=cluster.address)
    cluster.add_node(num_cpus=1, node_ip_address="127.0.0.5")
    cluster.wait_for_nodes(timeout=120)  # until the lost one counts as dead
    assert sorted(listener.names) == list(NAMES)
    assert result.counts["done"] == len(NAMES)
    remove_leftovers(root / "out")  # of the worker that died, as the next run does
    batch(root, output=root / "plain")
    assert results(root / "out") == results(root / "plain")


@pytest.mark.slow
def test_a_frame_that_kills_its_worker_is_named_and_the_others_are_done(
    cluster: Any, tmp_path: Path
) -> None:
    root = pairs_on_disk(tmp_path / "drive", NAMES[:6])
    add_frame(root, "bad", np.full((46, 62, 3), 255, np.uint8))
    model, start = root / "net" / "my_net.py", "    def forward(self, rgb):\n"
    model.write_text(model.read_text().replace(start, start + DEADLY))
    listener = RecordingListener()
    batch(root, listener, ray=cluster.address)
    records = {record.name: record for record in listener.records}
    assert len(records) == len(listener.records) == 7
    bad = records.pop("bad")
    assert bad.status == "failed"
    assert "worker died" in (bad.message or "")
    assert {record.status for record in records.values()} == {"done"}


@pytest.mark.slow
def test_a_mistake_of_all_frames_ends_a_batch_and_a_stopped_one_does_what_is_begun(
    cluster: Any, root: Path
) -> None:
    with pytest.raises(DeviceError, match="device cuda"):
        batch(root, ray=cluster.address, refine={"device": "cuda"})
    with pytest.raises(ModelError, match="nowhere"):
        batch(root, ray=cluster.address, refine={"layer": "nowhere"})
    assert not results(root / "out")
    listener = RecordingListener(lambda: bool(listener.records))
    batch(root, listener, ray=cluster.address)
    assert 1 <= len(listener.records) < len(NAMES)
    assert {path.stem for path in (root / "out").glob("f*.json")} == set(listener.names)


def test_addresses_of_clusters_what_is_none_and_the_missing_extra(
    root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for text in ("auto", "local", "host:6379", "ray://host:10001", "[::1]:6379"):
        assert parse_address(text) == text
    for text in ("frames/", "out", "ray://host", "a/b:1"):
        with pytest.raises(UsageError, match=text):
            parse_address(text)
    pytest.importorskip("ray")
    for scheme in ("", "ray://"):  # where nothing answers
        with pytest.raises(DeviceError, match=f"{scheme}127.0.0.1:9"):
            batch(root, ray=f"{scheme}127.0.0.1:9")
    with pytest.raises(UsageError, match="--device"):
        batch(root, ray="auto", refine={"device": "cuda:1"})
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(UsageError, match=r"pnpdepth\[ray\]"):
        batch(root, ray="local")


def test_a_batch_compares_input_ranges_on_three_frames(tmp_path: Path) -> None:
    root = pairs_on_disk(tmp_path / "drive")
    model = root / "net" / "my_net.py"
    model.write_text(model.read_text().replace("build=Net", "build=Net, normalisation=None"))
    batch(root)
    record = FrameRecord.read(root / "out" / "a.json")
    assert record.settings["normalise"] in NORMALISATIONS
    assert any("mean of 3 frames" in note for note in record.notes)
    assert spread(3) == [0, 1, 2]
    assert spread(37) == [0, 2, 4, 7, 9, 12, 14, 16, 19, 21, 24, 26, 28, 31, 33, 36]
