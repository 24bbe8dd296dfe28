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
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch

from pnpdepth_cli.choices import NORMALISATIONS
from pnpdepth_cli.commands.many_frames.running import spread
from pnpdepth_cli.commands.requests.batch_request import parse_address
from pnpdepth_cli.dataset.frame_record import FrameRecord
from pnpdepth_cli.errors import DeviceError, ModelError, OutputError, StorageError, UsageError
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


@pytest.mark.parametrize("text", ["auto", "local", "host:6379", "ray://host:10001", "[::1]:6379"])
def test_an_address_of_a_cluster_is_taken_as_it_is(text: str) -> None:
    assert parse_address(text) == text


@pytest.mark.parametrize("text", ["frames/", "out", "ray://host", "a/b:1"])
def test_what_is_no_address_of_a_cluster_is_refused(text: str) -> None:
    with pytest.raises(UsageError, match=text):
        parse_address(text)


@pytest.mark.parametrize("scheme", ["", "ray://"])
def test_an_address_where_nothing_answers_is_named(scheme: str, root: Path) -> None:
    pytest.importorskip("ray")
    with pytest.raises(DeviceError, match=f"{scheme}127.0.0.1:9"):
        batch(root, ray=f"{scheme}127.0.0.1:9")


def test_a_cluster_chooses_the_devices_itself(root: Path) -> None:
    pytest.importorskip("ray")
    with pytest.raises(UsageError, match="--device"):
        batch(root, ray="auto", refine={"device": "cuda:1"})


def test_a_cluster_without_ray_is_refused_with_what_installs_it(
    root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
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
    assert any("3 frames" in note for note in record.notes)


def test_the_frames_that_decide_are_spread_evenly_over_a_batch() -> None:
    assert spread(3) == [0, 1, 2]
    assert spread(37) == [0, 2, 4, 7, 9, 12, 14, 16, 19, 21, 24, 26, 28, 31, 33, 36]


def whole_batch(root: Path) -> None:
    torch.set_num_threads(1)
    batch(root)


def recorded(out: Path) -> dict[str, int]:
    """The frames that have a record, and when each depth map of theirs was written."""
    names = (name for name in FRAMES if (out / f"{name}.json").exists())
    return {name: (out / f"{name}_depth.png").stat().st_mtime_ns for name in names}


class Killed(NamedTuple):
    """A run that was killed: its exit code, the frames recorded before and after, its results."""

    exit_code: int
    before: dict[str, int]
    after: dict[str, int]
    results: dict[str, Any]

    @property
    def shown(self) -> set[str]:
        """The results but for hidden files, which were being written."""
        return {name for name in self.results if not Path(name).name.startswith(".")}

    @property
    def is_in_a_frame(self) -> bool:
        """Whether the kill left a frame half done."""
        depths = sum(name.endswith("_depth.png") for name in self.shown)
        return len(self.results) > len(self.shown) or depths > len(self.after)


class Kills(NamedTuple):
    """Batches that were killed, what one gives that was not, and the last one that ended."""

    killed: list[Killed]
    undisturbed: dict[str, Any]
    last_exit_code: int
    last: dict[str, Any]


@pytest.fixture(scope="module")
def kills(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Kills]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("OMP_NUM_THREADS", "1")
        yield kill_batches(tmp_path_factory.mktemp("kills"))


def kill_batches(folder: Path) -> Kills:
    """Kills batches at random moments until twelve of them had written a result."""
    context: Any = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([__name__])  # so that a batch begins in milliseconds
    root = pairs_on_disk(folder / "drive", FRAMES)
    out = root / "out"

    def begin() -> Any:
        process = context.Process(target=whole_batch, args=(root,))
        process.start()
        return process

    # What a batch gives, and how long it takes once the server runs.
    begin().join()
    undisturbed = results(out)
    shutil.rmtree(out)
    started = time.monotonic()
    begin().join()
    longest = time.monotonic() - started
    shutil.rmtree(out)
    # Each run goes on where the one before was killed, and one that ended begins anew.
    moments = random.Random(0)
    runs: list[Killed] = []
    while sum(run.exit_code != 0 and bool(run.shown) for run in runs) < 12:
        before = recorded(out)
        process = begin()
        time.sleep(moments.uniform(0, longest))
        process.kill()
        process.join()
        runs.append(Killed(process.exitcode, before, recorded(out), results(out)))
        if process.exitcode == 0:
            shutil.rmtree(out)
    process = begin()
    process.join()
    return Kills(runs, undisturbed, process.exitcode, results(out))


@pytest.mark.slow
def test_what_a_killed_batch_shows_is_whole(kills: Kills) -> None:
    for run in kills.killed:
        assert run.exit_code in (0, -9)
        shown = {name: run.results[name] for name in run.shown}
        assert shown.items() <= kills.undisturbed.items()
    assert any(run.is_in_a_frame for run in kills.killed)


@pytest.mark.slow
def test_a_batch_after_a_kill_does_no_frame_again_that_is_done(kills: Kills) -> None:
    for run in kills.killed:
        assert run.before.items() <= run.after.items()


@pytest.mark.slow
def test_many_kills_do_not_change_a_byte_of_the_results(kills: Kills) -> None:
    assert kills.last_exit_code == 0
    assert kills.last == kills.undisturbed


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
