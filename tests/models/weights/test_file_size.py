"""Sparse files of 100 GB, which cost nobody anything to make, are refused before they are read."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import pytest

from pnpdepth_cli.budget import size_problem
from pnpdepth_cli.errors import CheckpointError, ModelError
from pnpdepth_cli.models.formats.hugging_face import hf_definition
from pnpdepth_cli.models.formats.torch_export import exported_definition
from pnpdepth_cli.models.weights.checkpoint import read_checkpoint
from tests.models.weights.test_tensor_bundle import bundle, entry

LARGE = 100 << 30


def sparse_file(path: Path, head: bytes = b"") -> Path:
    with path.open("wb") as file:
        file.write(head)
        file.truncate(len(head) + LARGE)
    return path


def test_a_file_within_the_limit_has_no_problem(tmp_path: Path) -> None:
    path = tmp_path / "a"
    path.write_bytes(b"12345")
    assert size_problem(path, 5) is None
    assert size_problem(path, 4) == "has 5 bytes; at most 4 are read on this machine"


@pytest.mark.parametrize("suffix", [".safetensors", ".pt", ".npy", ".npz", ".index"])
def test_a_checkpoint_that_memory_cannot_hold_is_refused(tmp_path: Path, suffix: str) -> None:
    header = json.dumps({"a": {"dtype": "F32", "shape": [25 << 30], "data_offsets": [0, LARGE]}})
    head = struct.pack("<Q", len(header)) + header.encode() if suffix == ".safetensors" else b""
    with pytest.raises(CheckpointError, match="bytes; at most"):
        read_checkpoint(sparse_file(tmp_path / f"x{suffix}", head))


def test_a_shard_that_memory_cannot_hold_is_refused(tmp_path: Path) -> None:
    index = bundle(tmp_path, {"a": entry(1, (25 << 30,), 0, LARGE)}, b"")
    sparse_file(tmp_path / "x.data-00000-of-00001")
    with pytest.raises(CheckpointError, match="bytes; at most"):
        read_checkpoint(index)


def test_large_files_of_networks_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match="bytes; at most"):
        exported_definition(sparse_file(tmp_path / "x.pt2"))
    sparse_file(tmp_path / "config.json")
    with pytest.raises(ModelError, match="bytes; at most"):
        hf_definition(tmp_path)
