"""The variables of a TensorFlow checkpoint are read to the bit; what is broken is one line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from pnpdepth_cli.models.weights import read_checkpoint
from tests.models.weights.files import (
    block,
    bundle,
    entry,
    index_of,
    little,
    refused,
    varint,
    written,
)


def test_what_tensorflow_wrote_is_read_to_the_bit_or_refused_if_it_is_cut(tmp_path: Path) -> None:
    index = written(tmp_path)
    whole = index.read_bytes()
    expected = {
        "conv1.biases": torch.tensor([-1, 2.5, 3]),
        "conv1.weights": torch.arange(12.0).reshape(1, 2, 2, 3),
        "global_step": torch.tensor(70000),
        "half": torch.tensor([[1.5]], dtype=torch.float16),
        "kind": torch.tensor([True, False]),
    }
    torch.testing.assert_close(read_checkpoint(index), expected, rtol=0, atol=0)
    for length in range(len(whole)):
        index.write_bytes(whole[:length])
        refused(index)


def test_variables_of_two_files_are_read(tmp_path: Path) -> None:
    first = np.arange(6, dtype=np.float32)
    second = np.full((2, 1), 7, np.float32)
    entries = {"b/w": entry(1, (3,), 12, 12), "a/w": entry(1, (2, 1), 0, 8, 1)}
    entries["empty"] = entry(1, (0, 2), 0, 0, 1)
    index = bundle(tmp_path, entries, first.tobytes(), second.tobytes())
    values = {name: tensor.tolist() for name, tensor in read_checkpoint(index).items()}
    assert values == {"a.w": [[7], [7]], "b.w": [3, 4, 5], "empty": []}


@pytest.mark.parametrize(
    "entries",
    [
        {"a": entry(1, (3,), 0, 8)},
        {"a": entry(1, (2**62, 2**62, 0), 0, 0)},
        {"a": entry(1, (1,), 2**62, 4)},
        {"a": entry(8, (1,), 0, 8)},
        {"a": entry(1, (2,), 0, 8) + b"\x3a\x00"},
        {"a": entry(1, (2**64 - 1,), 0, 8)},
        {str(n): entry(1, (2,), 0, 8) for n in range(9)},
    ],
)
def test_claims_of_more_than_is_there_are_refused(
    entries: dict[str, bytes], tmp_path: Path
) -> None:
    refused(bundle(tmp_path, entries, b"\0" * 8))


def test_names_that_grow_and_blocks_named_again_take_no_memory(tmp_path: Path) -> None:
    index = tmp_path / "x.index"
    rows = [varint(n) + varint(1) + varint(0) + b"a" for n in range(60_000)]
    growing = b"".join(rows) + block([])[-13:]
    data = block([(b"%06d" % n, entry(1, (1,), 0, 4)) for n in range(500)])
    files = {"a name of": index_of(growing), "overlap": index_of(data, copies=20_000)}
    for message, content in files.items():
        index.write_bytes(content)
        with little():
            assert message in refused(index)
