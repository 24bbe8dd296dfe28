"""Arrays of whole numbers in MATLAB 5 files: as scipy writes them, damaged, and lying."""

from __future__ import annotations

import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pnpdepth_cli.errors import FileFormatError
from pnpdepth_cli.io.dataset.reading import read_matlab_array
from tests.fuzz.mutations import mutated


def write(path: Path, *, compressed: bool = False, **variables: Any) -> Path:
    from scipy.io import savemat

    savemat(path, variables, do_compression=compressed)
    return path


@pytest.mark.parametrize("compressed", [False, True])
@pytest.mark.parametrize("kind", ["u1", "i2", "u2", "i4", "u4", "i8", "u8", "f4", "f8"])
def test_what_scipy_wrote_is_read(kind: str, compressed: bool, tmp_path: Path) -> None:
    numbers = np.array([[1], [2], [100]], kind)
    other = np.ones((3, 4))
    path = write(tmp_path / "a.mat", compressed=compressed, trainNdxs=other, testNdxs=numbers)
    assert read_matlab_array(path, "testNdxs").tolist() == [1, 2, 100]
    with pytest.raises(FileFormatError, match="has no valNdxs"):
        read_matlab_array(path, "valNdxs")


@pytest.mark.parametrize("content", [[0.5], [np.nan], [1e300], ["text"], [1 + 2j]])
def test_what_is_no_list_of_whole_numbers_is_refused(content: Any, tmp_path: Path) -> None:
    path = write(tmp_path / "a.mat", a=np.array(content))
    try:
        values = read_matlab_array(path, "a")
    except FileFormatError as error:
        assert "\n" not in str(error)  # noqa: PT017
    else:
        assert content == [1 + 2j]  # the real part
        assert values.tolist() == [1]


def test_a_file_cut_anywhere_is_refused(tmp_path: Path) -> None:
    path = write(tmp_path / "a.mat", a=np.arange(9))
    whole = path.read_bytes()
    for length in range(1, len(whole)):
        path.write_bytes(whole[:length])
        with pytest.raises(FileFormatError):
            read_matlab_array(path, "a")


def test_a_variable_that_decompresses_to_much_more_takes_no_memory(tmp_path: Path) -> None:
    path = write(tmp_path / "a.mat", compressed=True, a=np.ones(8_000_000, np.uint8))
    tracemalloc.start()
    with pytest.raises(FileFormatError, match="goes beyond the end"):
        read_matlab_array(path, "a")
    assert tracemalloc.get_traced_memory()[1] < 4e6
    tracemalloc.stop()


@settings(max_examples=200, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), compressed=st.booleans())
def test_a_damaged_file_raises_only_our_errors(
    seed: int, compressed: bool, tmp_path_factory: pytest.TempPathFactory
) -> None:
    path = tmp_path_factory.getbasetemp() / "damaged.mat"
    write(path, compressed=compressed, a=np.arange(3, dtype=np.uint16))
    path.write_bytes(mutated(path.read_bytes(), np.random.default_rng(seed)) or b"x")
    try:
        read_matlab_array(path, "a")
    except FileFormatError as error:
        assert "\n" not in str(error)  # noqa: PT017
