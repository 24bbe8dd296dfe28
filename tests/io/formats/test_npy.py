"""Headers of NPY files."""

from __future__ import annotations

import io
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.lib import format as npy_format

from pnpdepth_cli.io.formats.npy import npy_bytes, read_npy_header


def test_threads_parse_one_header_at_a_time(monkeypatch: pytest.MonkeyPatch) -> None:
    parsing, parse = threading.Lock(), npy_format.read_array_header_1_0

    def alone(stream: io.BytesIO) -> Any:
        assert parsing.acquire(blocking=False), "two threads parse at once"
        try:
            time.sleep(0.01)
            return parse(stream)
        finally:
            parsing.release()

    monkeypatch.setattr(npy_format, "read_array_header_1_0", alone)
    data = npy_bytes(np.zeros((2, 3), np.float32))
    with ThreadPoolExecutor(4) as pool:
        headers = list(pool.map(lambda _: read_npy_header(Path("a.npy"), data), range(8)))
    assert {header[0] for header in headers} == {(2, 3)}
