"""Arrays come out of numpy files to the bit, and nothing that a pickle says is done."""

from __future__ import annotations

import base64
import sys
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from pnpdepth_cli.models.weights.pickled_files import read_numpy_file
from tests.models.weights.files import hostile, little, npy_of, pickled, refused

RING: dict[str, Any] = {}
RING["again"] = RING
PYTHON_2 = (
    "c-rleOH0F05QUSpX={AdXMMlAiJO4n!i8AZUWgF9OOf0(dIL7?NhV6bLN}%6SNYTQHr0h&*B&^tnKOJaXJiC%)*Iwb"
    "&`(0AmpxPDCyAe14@nsG<CKytAPd?oWyRgu7CO_$Ft{#InV{;yw3&YT9qLj(2rbmOaeIM!@jgMr!<@}3Tz`Y*y6(-V"
    "QaM<MFfWRGEDW*8O+|b;!_pATHm|>i(UYVUO{vKew;~m5)x(-%+00;7Ws|Tj73uLD8&lGzhgM0t#MW<;M%Wg`-L<YM"
    "jjsOvcVmaJD|k&rej29O`zdIDTF`-qLsbwn#yFC#f;ZH=JL>8K$AlA+r9Po8oG*8tqhA"
)
"""The pickle of an object array with a dict of dicts, as numpy wrote it under Python 2."""


def layers() -> dict[str, Any]:
    rng = np.random.default_rng(0)
    return {
        "conv1": {
            "weights": rng.normal(size=(7, 7, 3, 4)).astype(np.float32),
            "biases": rng.normal(size=4).astype(np.float32),
        },
        "bn_conv1": {"mean": rng.normal(size=300).astype(np.float32)},
        "alone": np.arange(6, dtype=np.int64),
    }


@pytest.mark.parametrize("protocol", [2, 3, 4])
def test_a_pickled_dict_of_dicts_gives_its_arrays_to_the_bit(protocol: int, tmp_path: Path) -> None:
    path = npy_of(tmp_path / "x.npy", pickled(layers(), protocol))
    arrays = read_numpy_file(path)
    assert list(arrays) == ["conv1.weights", "conv1.biases", "bn_conv1.mean", "alone"]
    numpys = np.load(path, allow_pickle=True, encoding="latin1").item()
    for name, tensor in arrays.items():
        layer, _, key = name.partition(".")
        own = numpys[layer][key] if key else numpys[layer]
        assert np.array_equal(tensor.numpy(), own)
        assert tensor.numpy().dtype == own.dtype
    assert arrays["conv1.weights"].is_contiguous()


def test_a_dict_of_arrays_that_python_2_wrote_is_read(tmp_path: Path) -> None:
    path = npy_of(tmp_path / "x.npy", zlib.decompress(base64.b85decode(PYTHON_2)))
    arrays = read_numpy_file(path)
    assert torch.equal(arrays["conv1.weights"], torch.full((2, 4, 2, 5), 0.25))
    assert torch.equal(arrays["conv1.biases"], torch.tensor([0.5, -1]))


@pytest.mark.parametrize("code", ["<f2", "<f4", "<f8", ">f4", ">i2", "|i1", "|u1", "<i4", "|b1"])
def test_every_type_order_and_shape_is_read(code: str, tmp_path: Path) -> None:
    base = np.arange(24).reshape(2, 3, 4).astype(np.dtype(code))
    arrays = {"c": base, "fortran": np.asfortranarray(base), "turned": base.T, "part": base[:, 1:]}
    arrays |= {"number": np.array(base[1, 1, 1]), "empty": base[:0]}
    read = read_numpy_file(npy_of(tmp_path / "x.npy", pickled(arrays)))
    for name, array in arrays.items():
        assert read[name].shape == array.shape
        assert np.array_equal(read[name].numpy(), array)


@pytest.mark.parametrize(
    "content",
    [
        [1, 2],
        "text",
        {"a": 1},
        {"a": {"b": "text"}},
        {"a": np.array(["x", "y"])},
        {"a": np.array([1 + 2j])},
        {"a": np.array([{}, 1], dtype=object)},
        {"a": {"b": {"c": {"d": np.ones(1)}}}},
        RING,
        {"a": torch.nn.Identity()},
    ],
)
def test_other_contents_are_named(content: Any, tmp_path: Path) -> None:
    refused(npy_of(tmp_path / "x.npy", pickled(content)))


@pytest.mark.parametrize("kind", hostile(Path("x")))
def test_nothing_of_a_hostile_pickle_runs(kind: str, tmp_path: Path) -> None:
    marker, before = tmp_path / "ran", set(sys.modules)
    content = {"w": {"weights": np.ones(2)}, "x": hostile(marker)[kind]}
    refused(npy_of(tmp_path / "bad.npy", pickled(content)))
    assert not marker.exists()
    assert set(sys.modules) == before


def array_of(**replaced: Any) -> Any:
    """An array of two float32, in whose pickle some parts are others."""
    reconstruct, arguments, state = np.ones(2, dtype=np.float32).__reduce__()  # type: ignore[misc]
    names = ("version", "shape", "dtype", "fortran", "data")
    parts = dict(zip(names, state, strict=True)) | replaced

    class Claims:
        def __reduce__(self) -> Any:
            return reconstruct, arguments, tuple(parts.values())

    return Claims()


BOMBS = {
    "a shape beyond the data": {"a": array_of(shape=(10**9,))},
    "a shape that overflows": {"a": array_of(shape=(2**40, 2**40))},
    "a negative shape": {"a": array_of(shape=(-1,))},
    "the same bytes as many arrays": {
        str(n): array_of(shape=(10**6,), data=data)
        for data in [b"\0" * 4 * 10**6]
        for n in range(100)
    },
    "very many entries": {
        str(n): layer
        for layer in [dict.fromkeys(map(str, range(500)), array_of())]
        for n in range(500)
    },
}


@pytest.mark.parametrize("kind", BOMBS)
def test_what_claims_to_be_larger_than_the_file_is_refused(kind: str, tmp_path: Path) -> None:
    path = npy_of(tmp_path / "bomb.npy", pickled(BOMBS[kind]))
    with little():
        refused(path)
