"""Weights from files: whole and fitting, or one line; nothing that is in a file is ever run."""

from __future__ import annotations

import json
import os
import struct
from collections import OrderedDict
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import save_file
from torch import Tensor, nn

from pnpdepth_cli.errors import ModelError
from pnpdepth_cli.models.definition import ModelDefinition, Multiple
from pnpdepth_cli.models.registry import find_definition
from pnpdepth_cli.models.weights import load_checkpoint
from tests.models.weights.files import bundle, entry, little, npy_of, pickled, refused


class Net(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.conv = nn.Conv2d(3, 4, 3)
        self.norm = nn.BatchNorm2d(4)


DEFINITION = ModelDefinition(name="net", input_kind="rgb", size=Multiple(1), build=Net)


def weights() -> dict[str, Tensor]:
    torch.manual_seed(3)
    return Net().state_dict()


def loads(path: Path, expected: Mapping[str, Tensor]) -> list[str]:
    """Loads a file with these weights; returns the notes."""
    network = Net()
    notes = load_checkpoint(network, DEFINITION, path)
    assert all(torch.equal(network.state_dict()[name], t) for name, t in expected.items())
    return notes


def save_arrays(state: Mapping[str, Tensor], path: Path) -> None:
    npy_of(path, pickled({name: tensor.numpy() for name, tensor in state.items()}))


def save_beside(state: Any, path: Path) -> None:
    optimiser = torch.optim.Adam(Net().parameters()).state_dict()
    torch.save({"epoch": 3, "optimizer": optimiser, "state_dict": OrderedDict(state)}, path)


save_older = partial(torch.save, _use_new_zipfile_serialization=False)
SAVES = {".safetensors": save_file, ".pth": torch.save, ".pth.tar": save_older, ".npy": save_arrays}


@pytest.mark.parametrize("suffix", [*SAVES, "", ".ckpt"])
def test_every_format_gives_its_weights_and_is_refused_if_cut(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"w{suffix}"
    for absent in (tmp_path, path):
        refused(absent)
    SAVES.get(suffix, save_beside)(weights(), path)
    assert loads(path, weights()) == []
    whole = path.read_bytes()
    for length in range(0, len(whole) - 1, max(1, len(whole) // 60)):
        path.write_bytes(whole[:length])
        refused(path)


@pytest.mark.parametrize("suffix", [*SAVES, ".index", ".ckpt"])
def test_no_pipe_or_endless_file_is_read(suffix: str, tmp_path: Path) -> None:
    os.mkfifo(tmp_path / f"pipe{suffix}")
    (tmp_path / f"endless{suffix}").symlink_to("/proc/self/pagemap")
    for name in ("pipe", "endless"):
        with little():
            refused(tmp_path / f"{name}{suffix}")
    with little():
        refused(tmp_path)  # a folder of both


@pytest.mark.parametrize("prefix", ["module.", "module.module.", "_orig_mod.", "model._orig_mod."])
def test_prefixes_of_parallel_or_compiled_modules_are_stripped(prefix: str, tmp_path: Path) -> None:
    state = {f"{prefix}{name}": tensor for name, tensor in weights().items()}
    torch.save({"state_dict": state}, tmp_path / "w.ckpt")
    (note,) = loads(tmp_path / "w.ckpt", weights())
    assert all(repr(f"{name}.") in note for name in prefix.split(".")[:-1])


@pytest.mark.parametrize("order", [1, -1])
def test_of_several_states_the_one_that_is_read_is_named(order: int, tmp_path: Path) -> None:
    averaged = {name: 2 * tensor for name, tensor in weights().items()}
    states = {"model": weights(), "ema": averaged, "epoch": 7}
    torch.save(dict(list(states.items())[::order]), tmp_path / "w.pth")
    (note,) = loads(tmp_path / "w.pth", weights())
    assert "'model' is read, not 'ema'" in note
    (note,) = loads(tmp_path / "w.pth:ema", averaged)
    assert "'ema' is read, not 'model'" in note
    with pytest.raises(ModelError, match="'teacher'"):
        loads(tmp_path / "w.pth:teacher", {})
    torch.save({"ema": {"state_dict": weights(), "decay": 0.9}, "epoch": 7}, tmp_path / "w.pth")
    refused(tmp_path / "w.pth")
    loads(tmp_path / "w.pth:ema", weights())


def test_every_kind_of_misfit_is_listed(tmp_path: Path) -> None:
    state = weights()
    del state["norm.running_mean"], state["norm.running_var"]
    state["norm.weight"][0] = float("nan")
    state["norm.bias"][0] = float("inf")
    state |= {f"extra{n}": torch.ones(1) for n in range(5)}
    state["conv.bias"] = torch.ones(7)
    state["conv.weight"] = state["conv.weight"] * 1j
    torch.save(state, tmp_path / "w.pth")
    with pytest.raises(ModelError) as error:
        loads(tmp_path / "w.pth", {})
    assert str(error.value).endswith(
        "2 missing (norm.running_mean, norm.running_var); 1 complex (conv.weight); 5 unexpected"
        " (extra0, extra1, extra2, extra3 and 1 more); 1 of another shape (conv.bias (7,) for"
        " (4,)); 2 NaN or infinite, as of a training that broke off (norm.weight, norm.bias)"
    )


@pytest.mark.parametrize(
    "content",
    [
        {},
        {10**7000: torch.ones(1), "epoch": 1},  # too long to print
        torch.ones(1),
        {"a": torch.ones(1), "w": torch.eye(3).to_sparse()},
        {"a": torch.zeros(1).expand(100_000, 100_000)},
    ],
)
def test_a_file_without_named_tensors_is_refused(content: Any, tmp_path: Path) -> None:
    torch.save(content, tmp_path / "w.pth")
    refused(tmp_path / "w.pth")


def test_files_that_memory_cannot_hold_are_refused_before_they_are_read(tmp_path: Path) -> None:
    large = 100 << 30  # bytes, which take no space
    stated = {"a": {"dtype": "F32", "shape": [large // 4], "data_offsets": [0, large]}}
    header = json.dumps(stated).encode()
    bundle(tmp_path, {"a": entry(1, (large // 4,), 0, large)}, b"")
    for name in ("y.safetensors", "y.pt", "y.npy", "y.index", "y.pt2", "config.json"):
        (tmp_path / name).write_bytes(struct.pack("<Q", len(header)) + header)
    for path in tmp_path.iterdir():
        if path.name != "x.index":
            os.truncate(path, path.stat().st_size + large)
    for name in ("y.safetensors", "y.pt", "y.npy", "y.index", "x.index"):
        refused(tmp_path / name)
    for spec in (tmp_path / "y.pt2", tmp_path):
        with pytest.raises(ModelError, match="bytes"):
            find_definition(str(spec))
