"""Files of weights: hostile pickles, .npy files of one object, and what a refusal is."""

from __future__ import annotations

import os
import pickle
import resource
import time
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
