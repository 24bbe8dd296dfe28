"""`batch --adapt`: weights that learn from each sequence first, and when they are not used."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

from pnpdepth_cli.cli.main import run
from pnpdepth_cli.errors import UsageError
from pnpdepth_cli.frames import adapt as adapting
from tests.commands import batches
from tests.commands.batches import Recorder, drive_on_disk

NETWORK = ("--model", "sparse2dense-tiny", "--iterations", "0", "--method", "alone")


@contextlib.contextmanager
def quick_learning() -> Iterator[pytest.MonkeyPatch]:
    """Four steps, also from points that count as dense."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(adapting, "is_dense", lambda points: False)
        patch.setattr(adapting, "STEPS", 4)
        yield patch


@pytest.fixture
def drive(tmp_path: Path) -> Iterator[Path]:
    """Eight frames whose points do not count as dense."""
    with quick_learning():
        yield drive_on_disk(tmp_path / "drive", frames=8)


def batch(drive: Path, *more: str) -> int:
    return run(["batch", str(drive), "-o", str(drive.parent / "out"), *NETWORK, "--adapt", *more])


class Adapted(NamedTuple):
    """The results of eight frames whose weights learnt, and whether those were better."""

    drive: Path
    out: Path
    is_better: bool

    @property
    def weights(self) -> Path:
        return self.out / "adapted/drive.safetensors"

    def batch(self) -> int:
        with quick_learning() as patch:
            patch.setattr(adapting.Learnt, "is_better", self.is_better)
            return batch(self.drive)


@pytest.fixture(scope="module", params=[True, False], ids=["better", "not better"])
def adapted(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Adapted:
    folder = tmp_path_factory.mktemp("adapted")
    found = Adapted(drive_on_disk(folder / "drive", frames=8), folder / "out", request.param)
    assert found.batch() == 0
    return found


def test_learnt_weights_are_kept_only_if_they_are_better(adapted: Adapted) -> None:
    assert adapted.weights.is_file() == adapted.is_better


def test_learnt_weights_are_used_for_every_frame_if_they_are_better(adapted: Adapted) -> None:
    records = [json.loads(path.read_text()) for path in adapted.out.glob("drive_*.json")]
    used = [record["result"]["model"]["checkpoint"] for record in records]
    assert len(used) == 8
    assert all((checkpoint == str(adapted.weights)) == adapted.is_better for checkpoint in used)


def test_what_was_learnt_and_refined_is_found_again(adapted: Adapted) -> None:
    before = {path: path.stat().st_mtime_ns for path in adapted.out.rglob("drive*")}
    assert len(before) > 16
    assert adapted.batch() == 0
    assert {path: path.stat().st_mtime_ns for path in before} == before


def test_a_batch_that_is_stopped_learns_nothing(drive: Path) -> None:
    network = {"model": "sparse2dense-tiny", "checkpoint": None, "iterations": 0}
    with pytest.raises(KeyboardInterrupt):
        batches.batch(drive, Recorder(lambda: True), adapt=True, refine=network)
    assert not list(drive.parent.rglob("adapted"))


def test_a_network_that_takes_no_points_cannot_learn_from_them(drive: Path) -> None:
    with pytest.raises(UsageError, match="--adapt"):
        batches.batch(drive, adapt=True, refine={"model": "fcrn-tiny", "checkpoint": None})
    assert not list(drive.parent.rglob("adapted"))


def test_nothing_is_learnt_from_a_sequence_with_a_bad_frame(drive: Path) -> None:
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
