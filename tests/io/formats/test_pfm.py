from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays

from pnpdepth_cli.errors import FileFormatError
from pnpdepth_cli.io.depth import read_depth
from pnpdepth_cli.io.formats.pfm import parse_pfm, pfm_bytes

HERE = Path("a.pfm")


@settings(max_examples=60, deadline=None)
@given(
    values=arrays(
        np.float32,
        array_shapes(min_dims=2, max_dims=2, max_side=9),
        elements=st.floats(width=32),
    )
)
def test_what_is_written_is_parsed_back_bit_for_bit(values: np.ndarray) -> None:
    again, factor = parse_pfm(HERE, pfm_bytes(values))
    assert factor == 1
    assert again.tobytes() == values.tobytes()
    assert again.shape == values.shape


def test_rows_run_from_bottom_to_top_in_both_byte_orders() -> None:
    bottom_up = np.array([[3, 4], [1, 2]], dtype=np.float32)
    little = b"Pf\n2 2\n-1.0\n" + bottom_up.astype("<f4").tobytes()
    big = b"Pf 2 2 1\n" + bottom_up.astype(">f4").tobytes()
    for content in (little, big):
        assert parse_pfm(HERE, content)[0].tolist() == [[1, 2], [3, 4]]


@pytest.mark.parametrize(
    "content",
    [
        b"Pf\n2 1\n-1\n" + bytes(7),
        b"Pf\n2 1\n-1\n" + bytes(9),
        b"Pf\n2 1\n0\n" + bytes(8),
        b"Pf\n2 1\n1e999\n" + bytes(8),
        b"Pf\n2 1\n--1\n" + bytes(8),
        b"Pf\n2 0\n-1\n",
        b"Pf\n-2 1\n-1\n" + bytes(8),
        b"Pf\n2\n-1\n" + bytes(8),
        b"PF\n1 1\n-1\n" + bytes(12),
        b"Pf",
    ],
)
def test_anything_but_the_exact_format_is_refused(content: bytes) -> None:
    with pytest.raises(FileFormatError, match=r"^a\.pfm"):
        parse_pfm(HERE, content)


def test_a_scale_factor_that_is_not_applied_is_mentioned(tmp_path: Path) -> None:
    (tmp_path / "a.pfm").write_bytes(b"Pf\n1 1\n-0.25\n" + np.float32(2).tobytes())
    depth = read_depth(tmp_path / "a.pfm")
    assert depth.values.tolist() == [[2]]
    assert depth.source == "PFM, scale factor 0.25 of its header not applied"
