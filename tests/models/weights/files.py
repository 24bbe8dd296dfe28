"""Files of weights: hostile pickles, .npy files of one object, and what a refusal is."""

from __future__ import annotations

import base64
import os
import pickle
import resource
import struct
import time
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.lib import format as npy

from pnpdepth_cli.errors import ModelError
from pnpdepth_cli.models.weights import read_checkpoint


def refused(path: Path) -> str:
    """The one short line that names the file."""
    with pytest.raises(ModelError) as error:
        read_checkpoint(path)
    message = str(error.value)
    assert str(path) in message
    assert "\n" not in message
    assert len(message) < 450 + len(str(path))
    return message


@contextmanager
def little(*, megabytes: int = 60, seconds: float = 5) -> Iterator[None]:
    """Inside, no more memory and processor time than this are taken."""
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    start = time.process_time()
    yield
    assert time.process_time() - start < seconds
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 1000 * megabytes


class Hostile:
    """Pickles as a call of a function."""

    def __init__(self, function: Callable[..., Any], *arguments: Any) -> None:
        self._call = (function, arguments)

    def __reduce__(self) -> Any:
        return self._call


def hostile(marker: Path) -> dict[str, Any]:
    """Objects whose pickles run something; several of them make the file `marker`."""
    touch = f"open({str(marker)!r}, 'w').close()"
    nested: Any = Hostile(exec, touch)
    for _ in range(20):
        nested = Hostile(map, nested, [nested])
    return {
        "os.system": Hostile(os.system, f"touch {marker}"),
        "exec": Hostile(exec, touch),
        "getattr": Hostile(getattr, Hostile(__import__, "os"), "system"),
        "nested": nested,
        "in a key": {("a", 1): Hostile(eval, touch)},
    }


def pickled(content: Any, protocol: int = 4) -> bytes:
    """A pickle of an object array with `content` in it."""
    holder = np.empty((), dtype=object)
    holder[()] = content
    return pickle.dumps(holder, protocol)


def npy_of(path: Path, content: bytes) -> Path:
    """A .npy of one object with this content behind its header."""
    with path.open("wb") as file:
        npy.write_array_header_1_0(file, {"descr": "|O", "fortran_order": False, "shape": ()})
        file.write(content)
    return path


def written(folder: Path) -> Path:
    """TensorFlow's checkpoint of four variables of numbers, and one of text."""
    for suffix, text in ((".index", INDEX), (".data-00000-of-00001", DATA)):
        (folder / f"x.ckpt{suffix}").write_bytes(zlib.decompress(base64.b85decode(text)))
    return folder / "x.ckpt.index"


def entry(dtype: int, shape: tuple[int, ...], offset: int, size: int, shard: int = 0) -> bytes:
    """A variable's entry: type, shape, shard, offset, size."""
    sides = [b"\x08" + varint(side) for side in shape]
    dims = b"".join(b"\x12" + varint(len(side)) + side for side in sides)
    place = b"\x18" + varint(shard) + b"\x20" + varint(offset) + b"\x28" + varint(size)
    return b"\x08" + varint(dtype) + b"\x12" + varint(len(dims)) + dims + place


def bundle(folder: Path, entries: dict[str, bytes], *contents: bytes) -> Path:
    """A checkpoint in two blocks, with a file for each of the contents."""
    header = b"\x08" + varint(len(contents)) + b"\x1a\x02\x08\x01"
    rows = [(key.encode(), value) for key, value in sorted(entries.items())]
    (folder / "x.index").write_bytes(index_of(block([(b"", header)]), block(rows)))
    for n, content in enumerate(contents):
        (folder / f"x.data-0000{n}-of-0000{len(contents)}").write_bytes(content)
    return folder / "x.index"


# Written by TensorFlow 2.21's tf.compat.v1.train.Saver.
INDEX = (
    "c-muNVB=tvV&Y(A;Nefs&nq+3Ps&UzPA%qO6k-u#;$YU`F|Ahe?O|h=El<r%&nN*&2mmD*ftU%3nH6|63{0;t3%$d@&6}Q"
    "+pOlyrUtE$}z`-fRpkSlHVe0zX?F$2oXhvdA8i%kD2UI(wf{O-|>Dgo4OBq-MvorHjIJm%eGAXzL#p5@eYXpktCFZ7bu!"
    "F@J6+ARJO{IN|?HPc85kzD^*8U3T9Qd?w0|O&-KEqx{xLEMg@A8KjInFckGY|yfzZ<$$O5JY*0C~nTga"
)


DATA = "c-muNXxPudpy0s3-~hxR&|nWFp!^0PUI4@gfcODO-jRVp0EiWU*ub$skP)KAj*)>SDe(2QlGKV40OZUKfd"


def varint(value: int) -> bytes:
    return bytes([value]) if value < 128 else bytes([value & 127 | 128]) + varint(value >> 7)


def block(entries: list[tuple[bytes, bytes]]) -> bytes:
    """A block of a table without shared beginnings, and its trailer."""
    lines = [varint(0) + varint(len(k)) + varint(len(v)) + k + v for k, v in entries]
    return b"".join(lines) + struct.pack("<II", 0, 1) + b"\0" + b"\0\0\0\0"


def index_of(*blocks: bytes, copies: int = 1) -> bytes:
    """An index that names each of these blocks of data so often."""
    data = b""
    handles = []
    for content in blocks:
        handles += [(b"\xff", varint(len(data)) + varint(len(content) - 5))] * copies
        data += content
    tables = b""
    for content in (block([]), block(handles)):
        tables += varint(len(data)) + varint(len(content) - 5)
        data += content
    return data + tables.ljust(40, b"\0") + struct.pack("<Q", 0xDB4775248B80FB57)
