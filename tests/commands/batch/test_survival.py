"""What is really done to a batch: kill -9, a full disk, a second run."""

from __future__ import annotations

import multiprocessing
import random
import shutil
import time
from pathlib import Path
from typing import Any

import pytest
import torch

from pnpdepth_cli.errors import OutputError, StorageError
from tests.commands.batches import NAMES, RecordingListener, batch, done, pairs_on_disk, results
from tests.io.test_atomic import no_room_on_disk

FRAMES = ("a", "b", "c", "sub/d", "sub/e")


def whole_batch(root: Path) -> None:
    torch.set_num_threads(1)
    batch(root)


def recorded(out: Path) -> dict[str, int]:
    """The frames that have a record, and when each depth map of theirs was written."""
    names = (name for name in FRAMES if (out / f"{name}.json").exists())
    return {name: (out / f"{name}_depth.png").stat().st_mtime_ns for name in names}


@pytest.mark.slow
def test_killed_many_times_at_random_moments_it_ends_byte_identical(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
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
    longest, moments = time.monotonic() - started, random.Random(0)
    shutil.rmtree(out)
    killed = interrupted = 0
    while killed < 12:
        before, process = recorded(out), begin()
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
    assert done(root) == list(NAMES)


def test_a_second_run_on_the_same_folder_is_refused_and_other_shards_are_not(
    tmp_path: Path,
) -> None:
    root = pairs_on_disk(tmp_path / "drive", NAMES[:2])
    inner = RecordingListener()

    def run_others() -> None:
        for shard in ((1, 2), None):
            with pytest.raises(OutputError, match="another batch"):
                batch(root, shard=shard)
        batch(root, inner, shard=(2, 2))

    outer = RecordingListener(on_frame=run_others)
    counts = batch(root, outer, shard=(1, 2)).counts
    assert (outer.names, inner.names) == (["a"], ["b"])
    assert counts["done"] == 2
