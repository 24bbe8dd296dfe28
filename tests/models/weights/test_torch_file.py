"""Real layouts are read to the bit, and nothing that a pickle says is done."""

from __future__ import annotations

import argparse
import collections
import io
import os
import pickle
import resource
import struct
import subprocess
import sys
import time
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from torch import nn

from pnpdepth_cli.errors import CheckpointError
from pnpdepth_cli.models.weights.checkpoint import read_checkpoint
from pnpdepth_cli.models.weights.pickle_reader import StandIn
from pnpdepth_cli.models.weights.torch_file import is_module, module_state, read_tensor_file

LAYOUTS = [True, False]


class Net(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.features = nn.Sequential(nn.Conv2d(3, 4, 3), nn.BatchNorm2d(4), nn.ReLU())
        self.head = nn.Conv2d(4, 1, 1)
        self.tied = self.head
        self.register_buffer("fleeting", torch.ones(3), persistent=False)
        self.narrow = nn.Parameter(torch.rand(2, 3).half().T)


def save(content: Any, path: Path, new: bool) -> Path:
    torch.save(content, path, _use_new_zipfile_serialization=new)
    return path


@pytest.mark.parametrize("new", LAYOUTS)
def test_a_published_layout_gives_the_modules_own_state(tmp_path: Path, new: bool) -> None:
    net = Net()
    content = {
        "args": argparse.Namespace(lr=0.1),
        "epoch": 3,
        "arch": "resnet",
        "model": net,
        "optimizer": torch.optim.SGD(net.parameters(), lr=0.1, momentum=0.9),
        "best": collections.defaultdict(list, a=[1.5]),
    }
    read = read_tensor_file(save(content, tmp_path / "net.pth.tar", new))
    assert list(read.content) == list(content)
    assert read.content["epoch"] == 3
    assert read.content["args"].state == {"lr": 0.1}
    assert is_module(read.content["model"])
    state, own = module_state(read.content["model"]), net.state_dict()
    assert state.keys() == own.keys()
    for name, tensor in own.items():
        assert state[name].dtype == tensor.dtype
        assert torch.equal(state[name], tensor)
    assert "argparse.Namespace" in read.named
    assert "torch.optim.sgd.SGD" in read.named


@pytest.mark.parametrize("new", LAYOUTS)
def test_every_dtype_view_and_empty_tensor_is_read_to_the_bit(tmp_path: Path, new: bool) -> None:
    base = torch.arange(24).reshape(4, 6)
    kinds = [torch.float32, torch.float64, torch.float16, torch.bfloat16, torch.int64, torch.int32]
    kinds += [torch.int16, torch.int8, torch.uint8, torch.bool]
    content = {str(kind): base.to(kind) for kind in kinds}
    content |= {"view": base[1:3, ::2], "turned": base.T, "number": torch.tensor(2.5)}
    content["empty"] = torch.empty(0, 3)
    read = read_tensor_file(save(content, tmp_path / "x.pt", new)).content
    for name, tensor in content.items():
        assert read[name].dtype == tensor.dtype
        assert torch.equal(read[name], tensor)


def test_published_completion_networks_are_read(shared_data: Path) -> None:
    for name in ("kitti", "nyu"):
        read = read_tensor_file(shared_data / "weights" / "pncnn" / f"{name}_model_best.pth.tar")
        state = module_state(read.content["model"])
        assert sum(t.numel() for n, t in state.items() if "num_batches" not in n) >= 335_000
        assert state["nconv.nconv1.weight_p"].shape == (2, 1, 5, 5)
    whole = read_tensor_file(shared_data / "weights" / "nconv" / "whole_module.pth").content
    assert isinstance(whole, StandIn)
    assert module_state(whole)["nconv7.bias"].shape == (1,)
    path = shared_data / "weights" / "nconv" / "CNN_ep0003.pth.tar"
    ours = read_tensor_file(path).content
    torchs = torch.load(path, map_location="cpu", weights_only=True)
    assert all(torch.equal(ours["net"][name], value) for name, value in torchs["net"].items())


class Hostile:
    """Pickles as a call of a function."""

    def __init__(self, function: Callable[..., Any], *arguments: Any) -> None:
        self._call = (function, arguments)

    def __reduce__(self) -> Any:
        return self._call


def hostile(marker: Path) -> dict[str, Any]:
    touch = f"open({str(marker)!r}, 'w').close()"
    nested: Any = Hostile(exec, touch)
    for _ in range(20):
        nested = Hostile(map, nested, [nested])
    return {
        "os.system": Hostile(os.system, f"touch {marker}"),
        "eval": Hostile(eval, touch),
        "exec": Hostile(exec, touch),
        "open": Hostile(open, str(marker), "w"),
        "subprocess": Hostile(subprocess.check_call, ["touch", str(marker)]),
        "torch loads": Hostile(torch.load, str(marker)),
        "pickle loads": Hostile(pickle.loads, pickle.dumps(Hostile(exec, touch))),
        "getattr": Hostile(getattr, Hostile(__import__, "os"), "system"),
        "nested": nested,
        "in a key": {("a", 1): Hostile(eval, touch)},
        "extension": Hostile(torch.hub.load, "a/b", "c"),
    }


@pytest.mark.parametrize("new", LAYOUTS)
@pytest.mark.parametrize("kind", hostile(Path("x")))
def test_nothing_of_a_hostile_pickle_runs(tmp_path: Path, kind: str, new: bool) -> None:
    marker = tmp_path / "ran"
    content = {"w": torch.ones(2), "x": hostile(marker)[kind]}
    path = save(content, tmp_path / "bad.pt", new)
    before = set(sys.modules)
    read = read_tensor_file(path)
    assert not marker.exists()
    assert set(sys.modules) == before
    assert torch.equal(read.content["w"], torch.ones(2))


def test_the_hostile_pickles_do_run_where_pickle_itself_reads_them(tmp_path: Path) -> None:
    marker = tmp_path / "ran"
    pickle.loads(pickle.dumps(hostile(marker)["exec"]))
    assert marker.exists()


@pytest.mark.parametrize("new", LAYOUTS)
def test_a_file_cut_anywhere_is_refused(tmp_path: Path, new: bool) -> None:
    whole = save({"model": Net(), "n": 3}, tmp_path / "x.pt", new).read_bytes()
    cut = tmp_path / "cut.pt"
    for length in range(0, len(whole) - 1, max(1, len(whole) // 60)):
        cut.write_bytes(whole[:length])
        with pytest.raises(CheckpointError, match=r"cut\.pt cannot be read"):
            read_tensor_file(cut)


@given(data=st.binary(max_size=200))
@settings(
    max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
def test_any_bytes_as_a_pickle_are_read_or_refused(tmp_path: Path, data: bytes) -> None:
    path = tmp_path / "x.pt"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("x/data.pkl", data)
    try:
        read_tensor_file(path)
    except CheckpointError:
        return


def archive_of(path: Path, pickled: bytes, storage: bytes = b"", **how: Any) -> Path:
    with zipfile.ZipFile(path, "w", **how) as archive:
        archive.writestr("x/data.pkl", pickled)
        archive.writestr("x/data/0", storage)
    return path


def tensor_pickle(elements: int, shape: tuple[int, ...], stride: tuple[int, ...]) -> bytes:
    """A pickle of one float32 tensor on storage 0, of whatever shape."""
    real = io.BytesIO()

    class Pickler(pickle.Pickler):
        def persistent_id(self, thing: Any) -> Any:
            if isinstance(thing, torch.UntypedStorage):
                return ("storage", torch.FloatStorage, "0", "cpu", elements)
            return None

    call = Hostile(
        torch._utils._rebuild_tensor_v2, torch.UntypedStorage(4), 0, shape, stride, False, {}
    )
    Pickler(real, protocol=2).dump(call)
    return real.getvalue()


BOMBS = {
    "a tensor repeated by strides of 0": (tensor_pickle(1, (10**12,), (0,)), b"\0" * 4),
    "a tensor beyond its storage": (tensor_pickle(1, (10**9,), (1,)), b"\0" * 4),
    "a side without end": (tensor_pickle(1, (float("inf"),), (1,)), b"\0" * 4),  # type: ignore[arg-type]
    "a storage larger than stored": (tensor_pickle(10**12, (10**12,), (1,)), b"\0" * 4),
    "a negative stride": (tensor_pickle(4, (2,), (-1,)), b"\0" * 16),
    "text longer than the file": (b"\x80\x02X" + struct.pack("<I", 2**32 - 1) + b"a.", b""),
    "bytes longer than the file": (b"\x80\x05\x96" + struct.pack("<Q", 2**62) + b"a.", b""),
    "a number longer than the file": (b"\x80\x02\x8b" + struct.pack("<i", 2**31 - 1) + b"a.", b""),
    "an unknown index in the memo": (b"\x80\x02j" + struct.pack("<I", 2**32 - 1) + b".", b""),
}


@pytest.mark.parametrize("kind", BOMBS)
def test_what_claims_to_be_larger_than_the_file_is_refused(tmp_path: Path, kind: str) -> None:
    path = archive_of(tmp_path / "bomb.pt", *BOMBS[kind])
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(CheckpointError, match=r"bomb\.pt cannot be read"):
        read_tensor_file(path)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 50_000  # kB


def test_a_length_that_no_file_has_is_refused_in_the_older_layout_too(tmp_path: Path) -> None:
    (tmp_path / "x.pt").write_bytes(b"\x80\x05\x8d" + struct.pack("<Q", 2**62) + b"a.")
    with pytest.raises(CheckpointError, match=r"x\.pt cannot be read"):
        read_tensor_file(tmp_path / "x.pt")


def test_tensors_of_one_storage_use_the_same_memory(tmp_path: Path) -> None:
    whole = torch.zeros(10**6)
    content = {"args": argparse.Namespace(lr=1), **{str(n): whole[n:] for n in range(300)}}
    torch.save(content, tmp_path / "x.pt")
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    tensors = read_tensor_file(tmp_path / "x.pt").content
    assert [len(tensors[str(n)]) for n in range(300)] == [10**6 - n for n in range(300)]
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 50_000  # kB


def test_a_large_memo_index_takes_no_memory(tmp_path: Path) -> None:
    pickled = b"\x80\x02]r" + struct.pack("<I", 2**32 - 1) + b"."
    assert read_tensor_file(archive_of(tmp_path / "x.pt", pickled)).content == []


def test_a_compressed_archive_is_refused_before_it_is_unpacked(tmp_path: Path) -> None:
    path = archive_of(
        tmp_path / "x.pt", pickle.dumps(1), b"\0" * 10**8, compression=zipfile.ZIP_DEFLATED
    )
    assert path.stat().st_size < 10**6
    with pytest.raises(CheckpointError, match="compressed"):
        read_tensor_file(path)


def test_entries_with_overlapping_bytes_are_refused(tmp_path: Path) -> None:
    path = archive_of(tmp_path / "x.pt", pickle.dumps(1), b"\0" * 5000)
    data = path.read_bytes()
    start = data.index(b"PK\x01\x02")  # the directory, whose entries for the storage are repeated
    end = data.index(b"PK\x05\x06")
    second = data.index(b"PK\x01\x02", start + 4)
    entry = data[second:end]
    copies = b"".join(entry.replace(b"x/data/0", b"x/data/%d" % n) for n in range(1, 9))
    tail = bytearray(data[end:])
    struct.pack_into("<HHII", tail, 8, 10, 10, end - start + len(copies), start)
    path.write_bytes(data[:end] + copies + bytes(tail))
    assert len(zipfile.ZipFile(path).infolist()) == 10
    with pytest.raises(CheckpointError, match="larger than the file"):
        read_tensor_file(path)


def test_modules_that_hold_themselves_again_and_again_are_refused() -> None:
    inner = StandIn("a.B", state={"_parameters": {"w": torch.ones(1)}, "_modules": {}})
    for _ in range(40):
        inner = StandIn("a.B", state={"_parameters": {}, "_modules": {"a": inner, "b": inner}})
    with pytest.raises(CheckpointError, match="without end"):
        module_state(inner)
    ring = StandIn("a.B", state={"_parameters": {}, "_modules": {}})
    ring.state["_modules"]["again"] = ring
    with pytest.raises(CheckpointError, match="without end"):
        module_state(ring)


def nested_tuples(depth: int) -> bytes:
    """Opcodes of a tuple that holds the one inside it twice, and that 1 twice, and so on."""
    return b"K\x01" + b"2\x86" * depth


NESTED = nested_tuples(200)
HANGS = {
    "printed": b"\x80\x02" + NESTED + b".",
    "as a key": b"\x80\x02}" + NESTED + b"K\x01s.",
    "as a key of a dict call": b"\x80\x02ccollections\nOrderedDict\n]("
    + NESTED
    + b"K\x01\x86e\x85R.",
    "in a set": b"\x80\x04\x8f(" + NESTED + b"\x90.",
    "in a frozenset": b"\x80\x04(" + NESTED + b"\x91.",
    "as a storage": b"\x80\x02(X\x07\x00\x00\x00storage" + NESTED * 4 + b"tQ.",
    "as a dtype": b"\x80\x02cnumpy\ndtype\n" + NESTED + b"\x85R.",
    "as a name": b"\x80\x04" + NESTED + b"2\x93.",
}


@pytest.mark.parametrize("kind", HANGS)
def test_a_small_pickle_that_is_large_when_printed_or_hashed_takes_no_time(
    kind: str, tmp_path: Path
) -> None:
    path = archive_of(tmp_path / "x.pt", HANGS[kind])
    assert path.stat().st_size < 2500
    start = time.process_time()
    with pytest.raises(CheckpointError) as error:
        read_checkpoint(path)
    assert time.process_time() - start < 5
    assert len(str(error.value)) < 500 + len(str(path))


def test_a_set_of_buffers_that_is_large_when_hashed_takes_no_time(tmp_path: Path) -> None:
    fleeting = StandIn("builtins.set", ([(), [], "fleeting", pickle.loads(NESTED + b".")],))
    buffers = {"fleeting": torch.ones(1), "kept": torch.ones(2)}
    state = {"_buffers": buffers, "_parameters": {}, "_non_persistent_buffers_set": fleeting}
    start = time.process_time()
    assert list(module_state(StandIn("a.B", state=state))) == ["kept"]
    assert time.process_time() - start < 5


LONG_NAME = b"X" + struct.pack("<I", 10**6) + b"a" * 10**6
ALLOCATES = {
    "a call for memory": b"\x80\x02cbuiltins\nbytearray\n\x8a\x05\x00\xe4\x0b\x54\x02\x85R.",
    "a dict copied again and again": b"\x80\x02ccollections\nOrderedDict\nq\x00]("
    + b"K\x01K\x02\x86" * 10**5
    + b"eq\x01\x85q\x02R("
    + b"h\x00h\x02R" * 10**5
    + b"t.",
    "a long name joined again and again": b"\x80\x04"
    + LONG_NAME
    + b"q\x00h\x00\x93("
    + b"h\x00h\x00\x93" * 10**4
    + b"t.",
    "steps without end": b"\x80\x02" + b"]0" * (2 * 10**6) + b"N.",
}


@pytest.mark.parametrize("kind", ALLOCATES)
def test_a_small_pickle_takes_no_memory(kind: str, tmp_path: Path) -> None:
    path = archive_of(tmp_path / "x.pt", ALLOCATES[kind])
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(CheckpointError):
        read_checkpoint(path)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 400_000  # kB


def test_integers_too_long_to_print_are_no_names(tmp_path: Path) -> None:
    torch.save({10**7000: torch.ones(1), "epoch": 1}, tmp_path / "x.pt")
    with pytest.raises(CheckpointError, match="no state dict; it holds int, epoch"):
        read_checkpoint(tmp_path / "x.pt")


def test_opcodes_that_are_not_on_the_list_are_refused(tmp_path: Path) -> None:
    for opcode in (
        b"\x82\x01",
        b"\x83\x01\x00",
        b"\x84\x01\x00\x00\x00",
        b"\x97",
        b"\x98",
        b"P1\n",
        b"\xff",
    ):
        path = archive_of(tmp_path / "x.pt", b"\x80\x05" + opcode + b".")
        with pytest.raises(CheckpointError, match=r"uses the opcode"):
            read_tensor_file(path)


def test_a_tensor_with_attributes_of_its_own_is_a_tensor(tmp_path: Path) -> None:
    weight = nn.Parameter(torch.ones(2, 3))
    weight.tag = "kept by torch.save"  # type: ignore[attr-defined]
    torch.save({"w": weight, "b": torch.ones(2, dtype=torch.uint16)}, tmp_path / "x.pt")
    state = read_checkpoint(tmp_path / "x.pt")
    assert torch.equal(state["w"], torch.ones(2, 3))
    assert state["b"].dtype == torch.uint16
