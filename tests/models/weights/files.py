"""Files of weights: hostile pickles, .npy files as Python 2 wrote them, and what a refusal is."""

from __future__ import annotations

import io
import os
import pickle
import resource
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
from numpy.lib import format as npy

from pnpdepth_cli.errors import CheckpointError
from pnpdepth_cli.models.weights.checkpoint import read_checkpoint


def refused(path: Path) -> str:
    """The one short line that names the file."""
    with pytest.raises(CheckpointError) as error:
        read_checkpoint(path)
    message = str(error.value)
    assert str(path) in message
    assert "\n" not in message
    assert len(message) < 450 + len(str(path))
    return message


@contextmanager
def little(*, megabytes: int = 60, seconds: float = 5) -> Iterator[None]:
    """Inside, no more memory and processor time than this are taken."""
    before, start = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.process_time()
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
        "pickle loads": Hostile(pickle.loads, pickle.dumps(Hostile(exec, touch))),
        "getattr": Hostile(getattr, Hostile(__import__, "os"), "system"),
        "nested": nested,
        "in a key": {("a", 1): Hostile(eval, touch)},
    }


class _Python2Pickler(pickle._Pickler):
    """Writes text and bytes as Python 2 wrote its strings."""

    dispatch: ClassVar[Any] = dict(pickle._Pickler.dispatch)

    def _string(self, arguments: str | bytes) -> None:
        raw = arguments.encode("latin-1") if isinstance(arguments, str) else arguments
        short = len(raw) < 256
        start = b"U" + bytes([len(raw)]) if short else b"T" + len(raw).to_bytes(4, "little")
        self.write(start + raw)
        self.memoize(arguments)

    dispatch[str] = _string
    dispatch[bytes] = _string


def pickled(content: Any, written_by: str) -> bytes:
    """A pickle of an object array with `content` in it, by "python 2" or a protocol's number."""
    holder = np.empty((), dtype=object)
    holder[()] = content
    if written_by == "python 2":
        file = io.BytesIO()
        _Python2Pickler(file, protocol=2).dump(holder)
        return file.getvalue().replace(b"cnumpy._core.multiarray\n", b"cnumpy.core.multiarray\n")
    return pickle.dumps(holder, protocol=int(written_by))


def npy_of(path: Path, content: bytes) -> Path:
    """A .npy of one object with this content behind its header."""
    with path.open("wb") as file:
        npy.write_array_header_1_0(file, {"descr": "|O", "fortran_order": False, "shape": ()})
        file.write(content)
    return path


def write_npy(path: Path, content: Mapping[str, Any], written_by: str = "python 2") -> Path:
    """A .npy with the dict in it, as numpy.save(path, content) gave it."""
    return npy_of(path, pickled(content, written_by))
