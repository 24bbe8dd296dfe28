"""Batches on a real Ray cluster, killed, on a full disk, in a second process; what decides."""

from __future__ import annotations

import multiprocessing
import os
import random
import shutil
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from pnpdepth_cli.commands.many_frames.running import spread
from pnpdepth_cli.commands.requests.batch_request import parse_address
from pnpdepth_cli.dataset.frame_record import FrameRecord
from pnpdepth_cli.errors import DeviceError, ModelError, OutputError, StorageError, UsageError
from pnpdepth_cli.frames.resolve import NORMALISATIONS
from pnpdepth_cli.io.atomic import remove_leftovers
from tests.commands.batches import Recorder, add_frame, batch, done, pairs_on_disk, results
from tests.io.full_disk import no_room_on_disk

NAMES = tuple(f"f{number:02}" for number in range(12))
FRAMES = ("a", "b", "c", "sub/d", "sub/e")
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

    listener = Recorder(on_frame=lose)
    result = batch(root, listener, ray=cluster.address)
    cluster.add_node(num_cpus=1, node_ip_address="127.0.0.5")
    cluster.wait_for_nodes(timeout=120)  # until the lost one counts as dead
    assert sorted(listener.names) == list(NAMES)
    assert result.counts["done"] == len(NAMES)
    remove_leftovers(root / "out")  # of the worker that died, as the next run does
    batch(root, output=root / "plain")
    assert results(root / "out") == results(root / "plain")


@pytest.mark.slow
def test_a_frame_that_kills_its_worker_is_named_others_done(cluster: Any, tmp_path: Path) -> None:
    root = pairs_on_disk(tmp_path / "drive", NAMES[:6])
    add_frame(root, "bad", np.full((46, 62, 3), 255, np.uint8))
    model = root / "net" / "my_net.py"
    start = "    def forward(self, rgb):\n"
    model.write_text(model.read_text().replace(start, start + DEADLY))
    listener = Recorder()
    batch(root, listener, ray=cluster.address)
    records = {record.name: record for record in listener.records}
    assert len(records) == len(listener.records) == 7
    bad = records.pop("bad")
    assert bad.status == "failed"
    assert "worker died" in (bad.message or "")
    assert {record.status for record in records.values()} == {"done"}


@pytest.mark.slow
def test_a_mistake_of_all_frames_or_the_user_ends_a_batch(cluster: Any, root: Path) -> None:
    with pytest.raises(DeviceError, match="device cuda"):
        batch(root, ray=cluster.address, refine={"device": "cuda"})
    with pytest.raises(ModelError, match="nowhere"):
        batch(root, ray=cluster.address, refine={"layer": "nowhere"})
    assert not results(root / "out")
    listener = Recorder(lambda: bool(listener.records))
    batch(root, listener, ray=cluster.address)
    assert 1 <= len(listener.records) < len(NAMES)
    assert {path.stem for path in (root / "out").glob("f*.json")} == set(listener.names)


def test_addresses_of_clusters_are_checked(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
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
    assert record.refined().settings["normalise"] in NORMALISATIONS
    assert any("mean of 3 frames" in note for note in record.notes)
    assert spread(3) == [0, 1, 2]
    assert spread(37) == [0, 2, 4, 7, 9, 12, 14, 16, 19, 21, 24, 26, 28, 31, 33, 36]


def whole_batch(root: Path) -> None:
    torch.set_num_threads(1)
    batch(root)


def recorded(out: Path) -> dict[str, int]:
    """The frames that have a record, and when each depth map of theirs was written."""
    names = (name for name in FRAMES if (out / f"{name}.json").exists())
    return {name: (out / f"{name}_depth.png").stat().st_mtime_ns for name in names}


@pytest.mark.slow
def test_many_kills_do_not_change_a_byte(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    context: Any = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([__name__])  # so that a batch begins in milliseconds
    root = pairs_on_disk(tmp_path / "drive", FRAMES)
    out = root / "out"

    def begin() -> Any:
        process = context.Process(target=whole_batch, args=(root,))
        process.start()
        return process

    begin().join()  # starts the server
    undisturbed = results(out)
    shutil.rmtree(out)
    started = time.monotonic()
    begin().join()
    longest = time.monotonic() - started
    moments = random.Random(0)
    shutil.rmtree(out)
    killed = interrupted = 0
    while killed < 12:
        before = recorded(out)
        process = begin()
        time.sleep(moments.uniform(0, longest))
        process.kill()
        process.join()
        assert process.exitcode in (0, -9)
        # What is there must be whole, but for hidden files, which were being written.
        there = results(out)
        shown = {name for name in there if not Path(name).name.startswith(".")}
        assert {name: there[name] for name in shown}.items() <= undisturbed.items()
        assert before.items() <= recorded(out).items(), "done work was done again"
        if process.exitcode == 0:
            shutil.rmtree(out)
        elif shown:
            killed += 1
            depths = sum(name.endswith("_depth.png") for name in shown)
            interrupted += len(there) > len(shown) or depths > len(recorded(out))
    assert interrupted > 0
    process = begin()
    process.join()
    assert process.exitcode == 0
    assert results(out) == undisturbed


def test_a_disk_that_is_full_stops_it_and_with_room_it_goes_on(tmp_path: Path) -> None:
    root = pairs_on_disk(tmp_path / "drive")
    with no_room_on_disk(), pytest.raises(StorageError, match="file too large"):
        batch(root)
    assert results(root / "out") == {}
    assert done(root) == list("abcd")


def test_a_second_run_on_a_folder_is_refused_other_shards_are_not(tmp_path: Path) -> None:
    root = pairs_on_disk(tmp_path / "drive", ("a", "b"))
    inner = Recorder()

    def run_others() -> None:
        for shard in ((1, 2), None):
            with pytest.raises(OutputError, match="another batch"):
                batch(root, shard=shard)
        batch(root, inner, shard=(2, 2))

    outer = Recorder(on_frame=run_others)
    counts = batch(root, outer, shard=(1, 2)).counts
    assert (outer.names, inner.names) == (["a"], ["b"])
    assert counts["done"] == 2
