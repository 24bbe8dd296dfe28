"""Batches on a real Ray cluster of three nodes."""

from __future__ import annotations

import os
import shutil
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pnpdepth_cli.commands.batch import ray_workers
from pnpdepth_cli.commands.batch.records import remove_all_leftovers
from pnpdepth_cli.dataset.frame_record import FrameRecord
from pnpdepth_cli.errors import ClusterError
from tests.commands.batches import RecordingListener, add_frame, batch, pairs_on_disk, results

pytest.importorskip("ray")
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(sys.platform != "linux", reason="nodes are addresses of loopback"),
]
NAMES = tuple(f"f{number:02}" for number in range(12))
DEADLY = "        if float(rgb.mean()) > 0.99:\n            import os\n            os._exit(1)\n"


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    """Three nodes of one CPU each, which are addresses of loopback."""
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
    from ray.cluster_utils import Cluster

    node = {"num_cpus": 1, "object_store_memory": 100 * 2**20}
    head = {**node, "node_ip_address": "127.0.0.2", "include_dashboard": False}
    nodes = Cluster(initialize_head=True, head_node_args=head)
    for number in (3, 4):
        nodes.add_node(**node, node_ip_address=f"127.0.0.{number}")
    yield nodes
    nodes.shutdown()


@pytest.fixture(scope="module")
def frames(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Frames of which one kills its worker, where the network is `deadly`."""
    root = pairs_on_disk(tmp_path_factory.mktemp("frames") / "drive", NAMES)
    batch(root)
    (root / "out").rename(root / "plain")
    return root


@pytest.fixture
def root(frames: Path) -> Iterator[Path]:
    yield frames
    shutil.rmtree(frames / "out", ignore_errors=True)


class Doing(RecordingListener):
    """Does something at a record."""

    def __init__(self, number: int, what: Callable[[], Any]) -> None:
        super().__init__()
        self._number, self._what = number, what

    def frame(self, record: FrameRecord) -> None:
        super().frame(record)
        if len(self.records) == self._number:
            self._what()


def different(root: Path) -> list[str]:
    """The names of the results that differ from those of one process.

    A worker dies some time after its node or driver; what it leaves half-written is removed, as
    the next run does.
    """
    remove_all_leftovers(root / "out")
    there, plain = results(root / "out"), results(root / "plain")
    names = there.keys() | plain.keys()
    return sorted(name for name in names if there.get(name) != plain.get(name))


def test_results_equal_those_of_one_process_when_a_node_is_lost(cluster: Any, root: Path) -> None:
    lost = cluster.worker_nodes.copy().pop()
    half_written = root / "out" / ".0123456789ab.png"

    def lose_a_node() -> None:
        half_written.write_bytes(b"of a worker that died")
        cluster.remove_node(lost, allow_graceful=False)

    listener = Doing(2, lose_a_node)
    result = batch(root, listener, ray=cluster.address)
    cluster.add_node(num_cpus=1, node_ip_address="127.0.0.5")
    assert not half_written.exists()
    cluster.wait_for_nodes(timeout=120)  # until the lost one counts as dead
    assert sorted(listener.names) == list(NAMES)
    assert different(root) == []
    assert result.counts["done"] == len(NAMES)


def test_a_frame_that_kills_its_worker_is_named_and_the_others_are_done(
    cluster: Any, tmp_path: Path
) -> None:
    root = pairs_on_disk(tmp_path / "drive", NAMES[:5])
    add_frame(root, "bad", np.full((46, 62, 3), 255, np.uint8))
    model = root / "net" / "my_net.py"
    start = "    def forward(self, rgb):\n"
    model.write_text(model.read_text().replace(start, start + DEADLY))
    listener = RecordingListener()
    batch(root, listener, ray=cluster.address)
    records = {record.name: record for record in listener.records}
    assert len(records) == len(listener.records) == 6
    bad = records.pop("bad")
    assert bad.status == "failed"
    assert (bad.message or "").startswith("its worker died 3 times")
    assert {record.status for record in records.values()} == {"done"}


def test_what_is_wrong_with_a_cluster_is_an_error(
    cluster: Any, root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(ClusterError, match="for 0 Ray workers with one GPU each, and 1 asked"):
        batch(root, ray=cluster.address, refine={"device": "cuda"})
    with monkeypatch.context() as changed:
        changed.setattr(ray_workers, "software", lambda: {"torch": "1.0"})
        with pytest.raises(
            ClusterError, match=r"has torch .* and the driver has 1\.0; install the"
        ):
            batch(root, ray=cluster.address)
    assert not results(root / "out")


def test_a_stopped_batch_ends_with_the_frames_that_are_begun(cluster: Any, root: Path) -> None:
    listener = RecordingListener()
    batch(
        root,
        listener,
        stopped=lambda: bool(listener.records),
        ray=cluster.address,
    )
    assert 1 <= len(listener.records) < len(NAMES)
    assert {path.stem for path in (root / "out").glob("f*.json")} == set(listener.names)
