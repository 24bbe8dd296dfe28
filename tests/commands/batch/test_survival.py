"""What is really done to a batch: kill -9, a full disk, a second run."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from pnpdepth_cli.errors import OutputError, StorageError
from tests.commands.batches import NAMES, RecordingListener, batch, done, pairs_on_disk, results
from tests.io.test_atomic import no_room_on_disk

ROOT = Path(__file__).parents[3]


@pytest.mark.slow
def test_killed_many_times_at_random_moments_it_ends_byte_identical(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "tests.commands.killed_batches", str(tmp_path), "12"],
        capture_output=True,
        text=True,
        check=False,
        cwd=ROOT,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
    )
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    assert report["kills"] == 12
    assert report["interrupted"] > 0


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
