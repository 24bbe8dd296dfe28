"""COLMAP's dense maps: a header in text, and rows of float32; what is cut short is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pnpdepth_cli.errors import InputError
from pnpdepth_cli.io.colmap_dense import is_dense_map, read_dense_map

ROWS = np.array([[1, 2, 3], [4, 0, 6]], np.float32)


def test_a_dense_map_of_colmap_is_read_along_x_first() -> None:
    # COLMAP writes Mat::Set(row, col) at slice × width × height + row × width + col.
    data = b"3&2&1&" + ROWS.tobytes()
    assert is_dense_map(data)
    np.testing.assert_array_equal(read_dense_map(Path("a.bin"), data).values, ROWS)


@pytest.mark.parametrize("data", [b"", b"3&2&", b"3,2,1,", b"-3&2&1&", b"PK", b"3&2&1"])
def test_other_content_is_no_dense_map(data: bytes) -> None:
    assert not is_dense_map(data)


@pytest.mark.parametrize(
    "data",
    [
        b"3&2&1&" + ROWS.tobytes()[:-1],
        b"3&2&1&" + ROWS.tobytes() + b"x",
        b"3&2&3&" + 3 * ROWS.tobytes(),  # normals
        b"0&2&1&",
        b"999999&999999&1&",
    ],
)
def test_a_map_that_is_cut_or_no_depth_is_refused(data: bytes) -> None:
    with pytest.raises(InputError, match=r"a\.bin"):
        read_dense_map(Path("a.bin"), data)
