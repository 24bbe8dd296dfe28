"""What is really done to a batch: kill -9, a full disk, a second run."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from pnpdepth_cli.errors import OutputError, StorageError
from pnpdepth_cli.io import lock
from tests.commands.batches import NAMES, RecordingListener, batch, pairs_on_disk, results
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


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 100 kB; `mount -o remount,size=…` makes it larger."""
    folder = tmp_path / "run" / "out"
    folder.mkdir(parents=True)
    mount = ["mount", "-t", "tmpfs", "-o", "size=100k", "tmpfs", str(folder)]
    try:
        mounted = subprocess.run(mount, capture_output=True, text=True, check=False)
    except FileNotFoundError:
        pytest.skip("there is no mount program")
    if mounted.returncode:
        pytest.skip(f"a small file system cannot be mounted here: {mounted.stderr.strip()}")
    yield folder
    subprocess.run(["umount", str(folder)], check=True)


def in_folder(folder: Path, root: Path, listener: RecordingListener | None = None) -> Any:
    """A batch into ./out of this folder, so that records name the same paths everywhere."""
    before = Path.cwd()
    folder.mkdir(exist_ok=True)
    os.chdir(folder)
    try:
        return batch(root, listener, output=Path("out"))
    finally:
        os.chdir(before)


@pytest.mark.slow
def test_a_full_disk_stops_it_cleanly_and_with_room_it_goes_on(
    tmp_path: Path, small_disk: Path
) -> None:
    root = pairs_on_disk(tmp_path / "drive")
    in_folder(tmp_path / "plain", root)
    undisturbed = results(tmp_path / "plain" / "out")
    stops = []
    for size_kb in range(100, 1000, 60):
        grow = ["mount", "-o", f"remount,size={size_kb}k", str(small_disk)]
        subprocess.run(grow, check=True)
        try:
            in_folder(small_disk.parent, root)
            break
        except StorageError as error:
            stops.append(str(error))
        assert results(small_disk).items() <= undisturbed.items()
    assert all("no space left on device" in text and "\n" not in text for text in stops)
    assert len(stops) > 3
    assert results(small_disk) == undisturbed


def test_files_that_cannot_grow_stop_it_too(tmp_path: Path) -> None:
    root = pairs_on_disk(tmp_path / "drive")
    with no_room_on_disk(), pytest.raises(StorageError, match="file too large"):
        batch(root)
    assert results(root / "out") == {}
    listener = RecordingListener()
    batch(root, listener)
    assert listener.names == list(NAMES)


def test_a_second_run_on_the_same_folder_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lock, "_TRIED_S", 0.05)
    root = pairs_on_disk(tmp_path / "drive")

    class Twice(RecordingListener):
        def frame(self, row: dict[str, Any]) -> None:
            super().frame(row)
            with pytest.raises(OutputError, match="another batch writes there; wait"):
                batch(root)
            with pytest.raises(OutputError, match="another batch writes there; wait"):
                batch(root, shard=(1, 2))

    listener = Twice()
    batch(root, listener, limit=1)
    assert listener.names == ["a"]
    batch(root)


def test_shards_run_at_once_but_not_twice_nor_with_others(tmp_path: Path) -> None:
    root = pairs_on_disk(tmp_path / "drive")
    inner = RecordingListener()

    class Beside(RecordingListener):
        def frame(self, row: dict[str, Any]) -> None:
            super().frame(row)
            if row["name"] != "a":
                return
            for shard in ((1, 2), None):
                with pytest.raises(OutputError, match="another batch writes there"):
                    batch(root, shard=shard)
            batch(root, inner, shard=(2, 2))

    outer = Beside()
    counts = batch(root, outer, shard=(1, 2)).summary["counts"]
    assert (outer.names, inner.names) == (["a", "c"], ["b", "d"])
    assert counts["done"] == 4


def test_a_record_that_says_less_than_it_should_is_not_taken_for_a_result(tmp_path: Path) -> None:
    root = pairs_on_disk(tmp_path / "drive")
    batch(root)
    records = [root / f"out/{name}.json" for name in NAMES]
    whole = json.loads(records[0].read_text())
    records[0].write_text(json.dumps(whole | {"batch": whole["batch"] | {"settings": "other"}}))
    records[1].unlink()  # as after a kill between the depth and its record
    listener = RecordingListener()
    batch(root, listener)
    assert listener.names == ["a", "b"]
    assert "2 to do (1 other settings, 1 interrupted)" in "\n".join(listener.messages)
    records[3].write_text("no JSON")
    with pytest.raises(OutputError, match=r"d\.json exists, and no batch wrote it; --overwrite"):
        batch(root)
    listener = RecordingListener()
    batch(root, listener, refine={"overwrite": True})
    assert listener.names == ["d"]


def test_a_shard_knows_what_failed_in_another(tmp_path: Path) -> None:
    root = pairs_on_disk(tmp_path / "drive")
    (root / "sparse/a.png").write_bytes(b"no depth")
    batch(root, shard=(1, 2))
    summary = batch(root, shard=(2, 2)).summary
    assert (summary["counts"]["done"], summary["counts"]["failed"]) == (3, 1)
