"""Torch and numpy files are read to the bit, and nothing that their pickles say is done."""

from __future__ import annotations

import argparse
import base64
import io
import pickle
import struct
import sys
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import nn

from pnpdepth_cli.models.weights import read_checkpoint
from pnpdepth_cli.models.weights.pickled_files import read_numpy_file, read_torch_file
from tests.models.weights.files import Hostile, hostile, little, npy_of, pickled, refused

both_layouts = pytest.mark.parametrize("new", [True, False], ids=["zip", "row of pickles"])


class Net(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.features = nn.Sequential(nn.Conv2d(3, 4, 3), nn.BatchNorm2d(4), nn.ReLU())
        self.head = nn.Conv2d(4, 1, 1)
        self.tied = self.head
        self.register_buffer("fleeting", torch.ones(3), persistent=False)
        self.narrow = nn.Parameter(torch.rand(2, 3).half().T)


def save(content: Any, path: Path, new: bool = True) -> Path:
    torch.save(content, path, _use_new_zipfile_serialization=new)
    return path


@both_layouts
def test_of_a_whole_module_the_state_is_read_the_rest_named(tmp_path: Path, new: bool) -> None:
    net = Net()
    notes = list[str]()
    optimiser = torch.optim.SGD(net.parameters(), lr=0.1, momentum=0.9)
    whole = {"args": argparse.Namespace(lr=0.1), "model": net, "optimizer": optimiser}
    state = read_checkpoint(save(whole, tmp_path / "net.pth.tar", new), notes)
    torch.testing.assert_close(state, dict(net.state_dict()), rtol=0, atol=0)
    assert notes[0].startswith("checkpoint net.pth.tar: its pickle names argparse.Namespace")


@pytest.mark.parametrize("protocol", range(2, pickle.HIGHEST_PROTOCOL + 1))
def test_a_module_and_sets_are_read_of_every_protocol(tmp_path: Path, protocol: int) -> None:
    net = Net()
    path = tmp_path / "net.pth"
    torch.save({"epochs": {1, 2}, "model": net}, path, pickle_protocol=protocol)
    torch.testing.assert_close(read_checkpoint(path), dict(net.state_dict()), rtol=0, atol=0)


@both_layouts
def test_every_dtype_view_and_empty_tensor_is_read_to_the_bit(tmp_path: Path, new: bool) -> None:
    base = torch.arange(24).reshape(4, 6)
    kinds = ("float32", "float64", "float16", "bfloat16", "int64", "int32", "int16", "int8")
    content = {kind: base.to(getattr(torch, kind)) for kind in (*kinds, "uint8", "bool")}
    content |= {"view": base[1:3, ::2], "turned": base.T, "number": torch.tensor(2.5)}
    content["empty"] = torch.empty(0, 3)
    read, _ = read_torch_file(save(content, tmp_path / "x.pt", new))
    torch.testing.assert_close(read, content, rtol=0, atol=0)


@pytest.mark.parametrize("how", ["zip", "row of pickles", "pickle alone", "numpy"])
@pytest.mark.parametrize("kind", hostile(Path("x")))
def test_nothing_of_a_hostile_pickle_runs(tmp_path: Path, kind: str, how: str) -> None:
    marker = tmp_path / "ran"
    path = tmp_path / ("bad.npy" if how == "numpy" else "bad.pt")
    content = {"w": torch.ones(2), "x": hostile(marker)[kind]}
    if how == "numpy":
        npy_of(path, pickled({**content, "w": np.ones(2)}))
    elif how == "pickle alone":
        path.write_bytes(pickle.dumps(content))
    else:
        save(content, path, how == "zip")
    before = set(sys.modules)
    refused(path)
    if how in ("zip", "row of pickles"):
        assert torch.equal(read_torch_file(path)[0]["w"], torch.ones(2))
    assert not marker.exists()
    assert set(sys.modules) == before


def archive_of(path: Path, pickled: bytes, storage: bytes, **how: Any) -> Path:
    with zipfile.ZipFile(path, "w", **how) as archive:
        archive.writestr("x/data.pkl", pickled)
        archive.writestr("x/data/0", storage)
    return path


def tensor_pickle(elements: int, shape: tuple[int, ...], stride: tuple[int, ...]) -> bytes:
    """A pickle of one float32 tensor on storage 0, of whatever shape."""
    content = io.BytesIO()
    storage = torch.UntypedStorage(4)
    pickler = pickle.Pickler(content, protocol=2)
    pid = ("storage", torch.FloatStorage, "0", "cpu", elements)
    pickler.persistent_id = lambda each: pid if each is storage else None  # type: ignore[method-assign]
    pickler.dump(Hostile(torch._utils._rebuild_tensor_v2, storage, 0, shape, stride, False, {}))
    return content.getvalue()


# opcodes of a tuple that holds the one inside it twice, and that 1 twice, and so on
NESTED = b"K\x01" + b"q\x00h\x00\x86" * 200
BOMBS = {
    "a tensor repeated by strides of 0": tensor_pickle(1, (10**12,), (0,)),
    "a tensor beyond its storage": tensor_pickle(1, (10**9,), (1,)),
    "a storage larger than stored": tensor_pickle(10**12, (10**12,), (1,)),
    "text longer than the file": b"\x80\x02X" + struct.pack("<I", 2**32 - 1) + b"a.",
    "tuples, printed": b"\x80\x02" + NESTED + b".",
    "tuples as a key": b"\x80\x02}" + NESTED + b"K\x01s.",
    "tuples in a set": b"\x80\x04\x8f(" + NESTED + b"\x90.",
    "tuples as a storage": b"\x80\x02(X\x07\x00\x00\x00storage" + NESTED * 4 + b"tQ.",
    "a call for memory": b"\x80\x02cbuiltins\nbytearray\n\x8a\x05\x00\xe4\x0b\x54\x02\x85R.",
}


@pytest.mark.parametrize("kind", BOMBS)
def test_a_small_pickle_takes_no_time_and_no_memory(kind: str, tmp_path: Path) -> None:
    path = archive_of(tmp_path / "bomb.pt", BOMBS[kind], b"\0" * 4)
    assert path.stat().st_size < 5000
    (tmp_path / "alone.pt").write_bytes(BOMBS[kind])
    with little(megabytes=50):
        refused(path)
        refused(tmp_path / "alone.pt")


def test_a_compressed_archive_is_refused_before_it_is_unpacked(tmp_path: Path) -> None:
    packed = {"compression": zipfile.ZIP_DEFLATED}
    path = archive_of(tmp_path / "x.pt", pickle.dumps(1), b"\0" * 10**8, **packed)
    with little():
        assert "compressed" in refused(path)


RING: dict[str, Any] = {}
RING["again"] = RING
PYTHON_2 = (
    "c-rleOH0F05QUSpX={AdXMMlAiJO4n!i8AZUWgF9OOf0(dIL7?NhV6bLN}%6SNYTQHr0h&*B&^tnKOJaXJiC%)*Iwb"
    "&`(0AmpxPDCyAe14@nsG<CKytAPd?oWyRgu7CO_$Ft{#InV{;yw3&YT9qLj(2rbmOaeIM!@jgMr!<@}3Tz`Y*y6(-V"
    "QaM<MFfWRGEDW*8O+|b;!_pATHm|>i(UYVUO{vKew;~m5)x(-%+00;7Ws|Tj73uLD8&lGzhgM0t#MW<;M%Wg`-L<YM"
    "jjsOvcVmaJD|k&rej29O`zdIDTF`-qLsbwn#yFC#f;ZH=JL>8K$AlA+r9Po8oG*8tqhA"
)
"""The pickle of an object array with a dict of dicts, as numpy wrote it under Python 2."""


def test_a_dict_of_arrays_that_python_2_wrote_is_read(tmp_path: Path) -> None:
    path = npy_of(tmp_path / "x.npy", zlib.decompress(base64.b85decode(PYTHON_2)))
    arrays = read_numpy_file(path)
    assert torch.equal(arrays["conv1.weights"], torch.full((2, 4, 2, 5), 0.25))
    assert torch.equal(arrays["conv1.biases"], torch.tensor([0.5, -1]))


@pytest.mark.parametrize("code", ["<f2", "<f4", "<f8", ">f4", ">i2", "|i1", "|u1", "<i4", "|b1"])
def test_arrays_of_every_type_order_and_shape_are_read_by_name(code: str, tmp_path: Path) -> None:
    base = np.arange(24).reshape(2, 3, 4).astype(np.dtype(code))
    layer = {"fortran": np.asfortranarray(base), "turned": base.T, "part": base[:, 1:]}
    arrays = {"number": np.array(base[1, 1, 1]), "empty": base[:0]}
    read = read_numpy_file(npy_of(tmp_path / "x.npy", pickled({"conv": layer, **arrays})))
    arrays |= {f"conv.{name}": array for name, array in layer.items()}
    native = {name: torch.tensor(array.astype(base.dtype.type)) for name, array in arrays.items()}
    torch.testing.assert_close(read, native, rtol=0, atol=0)


class Claims:
    """Pickles as an array of float32 of a claimed shape."""

    def __init__(self, shape: tuple[int, ...] = (2,), data: bytes = bytes(8)) -> None:
        self.shape, self.data = shape, data

    def __reduce__(self) -> Any:
        call, arguments, state = np.ones(2, np.float32).__reduce__()  # type: ignore[misc]
        return call, arguments, (state[0], self.shape, *state[2:4], self.data)


LARGE = bytes(4 * 10**6)
LAYER = dict.fromkeys(map(str, range(500)), Claims())
REFUSED = {
    "a list": [1, 2],
    "text": {"a": {"b": "text"}},
    "objects": {"a": np.array([{}, 1], dtype=object)},
    "a ring": RING,
    "a module": {"a": nn.Identity()},
    "a shape beyond the data": {"a": Claims(shape=(10**9,))},
    "the same bytes as many arrays": {str(n): Claims((10**6,), LARGE) for n in range(100)},
    "very many entries": dict.fromkeys(map(str, range(500)), LAYER),
}


@pytest.mark.parametrize("kind", REFUSED)
def test_what_is_no_dict_of_arrays_or_too_large_is_refused(kind: str, tmp_path: Path) -> None:
    path = npy_of(tmp_path / "bomb.npy", pickled(REFUSED[kind]))
    with little():
        refused(path)
