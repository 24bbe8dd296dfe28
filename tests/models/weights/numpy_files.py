""".npy files with a pickled dict in them, as Python 2 and versions of numpy write them."""

from __future__ import annotations

import io
import pickle
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.lib import format as npy


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


def write_npy(path: Path, content: Mapping[str, Any], written_by: str = "python 2") -> Path:
    """A .npy with the dict in it, as numpy.save(path, content) gave it."""
    with path.open("wb") as file:
        npy.write_array_header_1_0(file, {"descr": "|O", "fortran_order": False, "shape": ()})
        file.write(pickled(content, written_by))
    return path
