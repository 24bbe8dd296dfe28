"""A published checkpoint becomes safetensors, or stays as it is with one line that says why."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file

from pnpdepth_cli.commands.networks.weights import convert_checkpoint
from pnpdepth_cli.errors import CheckpointError, OutputError, UsageError


def saved(content: Any, path: Path) -> Path:
    torch.save(content, path)
    return path


def test_tensors_that_share_memory_are_written_one_by_one(tmp_path: Path) -> None:
    whole = torch.arange(6.0)
    source = saved({"a": whole, "b": whole[2:], "c": torch.ones(1).expand(2, 3)}, tmp_path / "w.pt")
    converted = convert_checkpoint(source, tmp_path / "w.safetensors")
    assert (converted["tensors"], converted["values"]) == (3, 16)
    state = load_file(tmp_path / "w.safetensors")
    assert torch.equal(state["b"], whole[2:])
    assert torch.equal(state["c"], torch.ones(2, 3))


def refused(source: Path) -> str:
    target = source.with_suffix(".safetensors")
    with pytest.raises(CheckpointError) as error:
        convert_checkpoint(source, target)
    assert "\n" not in str(error.value)
    assert not target.exists()
    return str(error.value)


def test_a_small_file_cannot_become_a_large_one(tmp_path: Path) -> None:
    huge = torch.zeros(1).expand(100_000, 100_000)
    assert " 1e+10 elements" in refused(saved({"w": huge}, tmp_path / "w.pt"))
    whole = torch.zeros(10**6)
    many = {str(n): whole[n:] for n in range(1000)}
    assert "share memory" in refused(saved(many, tmp_path / "many.pt"))


@pytest.mark.parametrize(
    ("tensor", "kind"),
    [
        (torch.eye(3).to_sparse(), "no state dict of plain tensors"),
        (torch.eye(3).to_sparse_csr(), "no state dict of plain tensors"),
        (torch.empty(3, device="meta"), "no state dict of plain tensors"),
        (torch.quantize_per_tensor(torch.ones(3), 0.1, 0, torch.qint8), "quantised"),
    ],
)
@pytest.mark.parametrize("inside", [True, False])
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_a_tensor_of_an_unusual_kind_is_refused(
    tensor: Any, kind: str, inside: bool, tmp_path: Path
) -> None:
    state = {"layer.weight": tensor, "layer.bias": torch.ones(1)}
    content = {"state_dict": state} if inside else state
    reason = refused(saved(content, tmp_path / "w.pt"))
    assert kind in reason


def test_a_name_that_safetensors_files_reserve_is_refused(tmp_path: Path) -> None:
    assert "'__metadata__'" in refused(saved({"__metadata__": torch.ones(1)}, tmp_path / "w.pt"))


def test_complex_tensors_are_stored(tmp_path: Path) -> None:
    source = saved({"w": torch.ones(2, dtype=torch.complex64)}, tmp_path / "w.pt")
    convert_checkpoint(source, tmp_path / "w.safetensors")
    assert load_file(tmp_path / "w.safetensors")["w"].dtype == torch.complex64


def test_a_file_is_replaced_only_where_that_is_asked_for(tmp_path: Path) -> None:
    source, target = saved({"w": torch.ones(2)}, tmp_path / "w.pt"), tmp_path / "w.safetensors"
    target.write_bytes(b"other")
    with pytest.raises(OutputError, match="exists"):
        convert_checkpoint(source, target)
    assert target.read_bytes() == b"other"
    convert_checkpoint(source, target, overwrite=True)
    assert torch.equal(load_file(target)["w"], torch.ones(2))


def test_a_checkpoint_does_not_replace_itself(tmp_path: Path) -> None:
    source = saved({"w": torch.ones(2)}, tmp_path / "w.safetensors")
    before = source.read_bytes()
    with pytest.raises(UsageError, match="is the checkpoint itself"):
        convert_checkpoint(source, source, overwrite=True)
    assert source.read_bytes() == before
    with pytest.raises(UsageError, match=r"name the converted file \.safetensors"):
        convert_checkpoint(source, tmp_path / "w.pt")
