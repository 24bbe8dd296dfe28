"""`batch --adapt`: weights that learn from each sequence first, and when they are not used."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from pnpdepth_cli.cli.main import run
from pnpdepth_cli.errors import UsageError
from pnpdepth_cli.frames import adapt as adapting
from tests.commands import batches
from tests.commands.batches import Recorder, drive_on_disk

NETWORK = ("--model", "sparse2dense-tiny", "--iterations", "0")


@pytest.fixture
def drive(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Eight frames whose points do not count as dense."""
    monkeypatch.setattr(adapting, "is_dense", lambda points: False)
    monkeypatch.setattr(adapting, "STEPS", 4)
    return drive_on_disk(tmp_path / "drive", frames=8)


def batch(drive: Path, *more: str) -> int:
    return run(["batch", str(drive), "-o", str(drive.parent / "out"), *NETWORK, "--adapt", *more])


@pytest.mark.parametrize("is_better", [True, False])
def test_weights_are_kept_used_for_every_frame_and_found_again_if_they_are_better(
    is_better: bool, drive: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(adapting.Learnt, "is_better", is_better)
    assert batch(drive) == 0
    out, weights = drive.parent / "out", drive.parent / "out/adapted/drive.safetensors"
    records = [json.loads(path.read_text()) for path in out.glob("drive_*.json")]
    used = [record["result"]["model"]["checkpoint"] for record in records]
    assert [checkpoint == str(weights) for checkpoint in used] == [is_better] * 8
    assert weights.is_file() == is_better
    before = {path: path.stat().st_mtime_ns for path in out.rglob("drive*")}
    assert len(before) > 16
    assert batch(drive) == 0  # does nothing
    assert {path: path.stat().st_mtime_ns for path in before} == before


def test_stopped_without_use_of_points_or_with_a_bad_frame_nothing_is_learnt(drive: Path) -> None:
    network = {"model": "sparse2dense-tiny", "checkpoint": None, "iterations": 0}
    with pytest.raises(KeyboardInterrupt):
        batches.batch(drive, Recorder(lambda: True), adapt=True, refine=network)
    with pytest.raises(UsageError, match="--adapt needs a network that takes points"):
        batches.batch(drive, adapt=True, refine={"model": "fcrn-tiny", "checkpoint": None})
    (drive / "rgb/drive_000.png").write_bytes(b"")
    assert batch(drive) == 7
    assert len(list((drive.parent / "out").glob("drive_*_depth.png"))) == 7
    assert not list(drive.parent.rglob("adapted"))


@pytest.mark.parametrize(
    ("count", "said"),
    [(7, "7 frames; at least 8 are needed"), (8, "points as dense as a LiDAR's teach nothing")],
)
def test_few_frames_and_dense_points_are_not_learnt_from(
    count: int, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert batch(drive_on_disk(tmp_path / "drive", frames=count)) == 0, capsys.readouterr().err
    assert said in capsys.readouterr().err
    assert json.loads((tmp_path / "out/adapted/drive.json").read_text())["why"] == said
