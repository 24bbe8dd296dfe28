"""`pnpdepth adapt`: weights learn from the points of a folder, and are used by --checkpoint."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch

from pnpdepth_cli.cli.main import run
from pnpdepth_cli.models.network import load_network
from pnpdepth_cli.models.weights.checkpoint import read_checkpoint
from tests.commands.drives import drive_on_disk

NETWORK = "sparse2dense-tiny"


def adapted(root: Path, *more: str) -> int:
    command = ["adapt", str(root), "-o", str(root / "adapted.safetensors"), "--model", NETWORK]
    return run([*command, *more])


def test_adapted_weights_fit_hidden_points_better_and_are_used_by_checkpoint(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = drive_on_disk(tmp_path, frames=4)
    assert adapted(root, "--steps", "20", "--json") == 0
    record = json.loads(capsys.readouterr().out)
    assert (record["training_frames"], record["validation_frames"]) == (3, 1)
    kept = str(record["kept"])
    assert record["losses"][kept] == min(record["losses"].values()) < record["losses"]["0"]
    command = ["batch", str(root), "-o", str(root / "out"), "--model", NETWORK, "--limit", "1"]
    command += ["--iterations", "0", "--checkpoint", str(root / "adapted.safetensors")]
    assert run(command) == 0
    model = json.loads((root / "out/drive_000.json").read_text())["model"]
    assert model["checkpoint"] == str(root / "adapted.safetensors")


def test_the_same_seed_gives_the_same_bytes_of_all_tensors_and_a_card(tmp_path: Path) -> None:
    root = drive_on_disk(tmp_path, frames=3)
    written = []
    for _ in range(2):
        assert adapted(root, "--steps", "6", "--overwrite") == 0
        written.append((root / "adapted.safetensors").read_bytes())
    assert written[0] == written[1]
    state = load_network(NETWORK, None).module.state_dict()
    tensors = read_checkpoint(root / "adapted.safetensors")
    assert {name: value.shape for name, value in tensors.items()} == {
        name: value.shape for name, value in state.items()
    }
    card = (root / "adapted.md").read_text()
    assert f"`{NETWORK}`, adapted to the frames of `{root}`" in card
    assert "frames to learn from: 2; for validation:\n  1;" in card
    assert "the network's own weights" in card


def test_weights_that_get_worse_are_not_written(tmp_path: Path) -> None:
    root = drive_on_disk(tmp_path, frames=2)
    assert adapted(root, "--steps", "5", "--lr", "0.1") == 0
    written = read_checkpoint(root / "adapted.safetensors")
    state = load_network(NETWORK, None).module.state_dict()
    assert all(bool((written[name] == value).all()) for name, value in state.items())
    assert "after 0 updates" in (root / "adapted.md").read_text()


def test_existing_files_are_not_replaced(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = drive_on_disk(tmp_path, frames=2)
    (root / "adapted.md").write_text("mine")
    assert adapted(root, "--steps", "1") == 2
    assert "adapted.md exists; --overwrite" in capsys.readouterr().err
    assert (root / "adapted.md").read_text() == "mine"
    assert adapted(root, "-o", str(root / "w.pt")) == 2
    assert "name the file of the weights NAME.safetensors" in capsys.readouterr().err


@pytest.mark.slow
def test_weights_of_the_start_are_written_under_their_own_names(tmp_path: Path) -> None:
    root = drive_on_disk(tmp_path, frames=2)
    command = ["adapt", str(root), "-o", str(root / "adapted.safetensors")]
    assert run([*command, "--steps", "4", "--lr", "0.5"]) == 0  # compact; its encoder does not move
    written = read_checkpoint(root / "adapted.safetensors")
    for name, value in load_network("compact", None).module.state_dict().items():
        assert torch.equal(written[name], value), name
