"""The variables of a TensorFlow checkpoint are read to the bit; what is broken is one line."""

from __future__ import annotations

import base64
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
import torch

from pnpdepth_cli.models.weights import read_checkpoint
from tests.models.weights.files import little, refused

# Written by TensorFlow 2.21's tf.compat.v1.train.Saver.
INDEX = (
    "c-muNVB=tvV&Y(A;Nefs&nq+3Ps&UzPA%qO6k-u#;$YU`F|Ahe?O|h=El<r%&nN*&2mmD*ftU%3nH6|63{0;t3%$d@&6}Q"
    "+pOlyrUtE$}z`-fRpkSlHVe0zX?F$2oXhvdA8i%kD2UI(wf{O-|>Dgo4OBq-MvorHjIJm%eGAXzL#p5@eYXpktCFZ7bu!"
    "F@J6+ARJO{IN|?HPc85kzD^*8U3T9Qd?w0|O&-KEqx{xLEMg@A8KjInFckGY|yfzZ<$$O5JY*0C~nTga"
)
DATA = "c-muNXxPudpy0s3-~hxR&|nWFp!^0PUI4@gfcODO-jRVp0EiWU*ub$skP)KAj*)>SDe(2QlGKV40OZUKfd"


def written(folder: Path) -> Path:
    """TensorFlow's checkpoint of four variables of numbers, and one of text."""
    for suffix, text in ((".index", INDEX), (".data-00000-of-00001", DATA)):
        (folder / f"x.ckpt{suffix}").write_bytes(zlib.decompress(base64.b85decode(text)))
    return folder / "x.ckpt.index"


def varint(value: int) -> bytes:
    return bytes([value]) if value < 128 else bytes([value & 127 | 128]) + varint(value >> 7)


def entry(dtype: int, shape: tuple[int, ...], offset: int, size: int, shard: int = 0) -> bytes:
    """A variable's entry: type, shape, shard, offset, size."""
    sides = [b"\x08" + varint(side) for side in shape]
    dims = b"".join(b"\x12" + varint(len(side)) + side for side in sides)
    place = b"\x18" + varint(shard) + b"\x20" + varint(offset) + b"\x28" + varint(size)
    return b"\x08" + varint(dtype) + b"\x12" + varint(len(dims)) + dims + place


def block(entries: list[tuple[bytes, bytes]]) -> bytes:
    """A block of a table without shared beginnings, and its trailer."""
    lines = [varint(0) + varint(len(k)) + varint(len(v)) + k + v for k, v in entries]
    return b"".join(lines) + struct.pack("<II", 0, 1) + b"\0" + b"\0\0\0\0"


def index_of(*blocks: bytes, copies: int = 1) -> bytes:
    """An index that names each of these blocks of data so often."""
    data, handles = b"", []
    for part in blocks:
        handles += [(b"\xff", varint(len(data)) + varint(len(part) - 5))] * copies
        data += part
    tables = b""
    for part in (block([]), block(handles)):
        tables += varint(len(data)) + varint(len(part) - 5)
        data += part
    return data + tables.ljust(40, b"\0") + struct.pack("<Q", 0xDB4775248B80FB57)


def bundle(folder: Path, entries: dict[str, bytes], *contents: bytes) -> Path:
    """A checkpoint in two blocks, with a file for each of the contents."""
    header = b"\x08" + varint(len(contents)) + b"\x1a\x02\x08\x01"
    rows = [(key.encode(), value) for key, value in sorted(entries.items())]
    (folder / "x.index").write_bytes(index_of(block([(b"", header)]), block(rows)))
    for n, content in enumerate(contents):
        (folder / f"x.data-0000{n}-of-0000{len(contents)}").write_bytes(content)
    return folder / "x.index"


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
    first, second = np.arange(6, dtype=np.float32), np.full((2, 1), 7, np.float32)
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
