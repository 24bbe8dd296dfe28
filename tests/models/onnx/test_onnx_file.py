"""ONNX files as networks: named, cut, refined, checked against onnxruntime, or refused."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

pytest.importorskip("onnx", reason="needs the extra [onnx]")
pytest.importorskip("onnxruntime", reason="needs the extra [onnx]")

import onnx
from onnx import helper, numpy_helper

from pnpdepth_cli.core.split import Split
from pnpdepth_cli.errors import ModelError
from pnpdepth_cli.models.definition import Multiple
from pnpdepth_cli.models.network import Network, load_network
from pnpdepth_cli.models.onnx.operators import OPERATORS
from tests.models.onnx.onnx_files import write_network
from tests.models.weights.files import little

IMAGE = torch.rand(1, 3, 32, 48, generator=torch.Generator().manual_seed(0))


def refused(path: Path, spec: str | None = None) -> str:
    with pytest.raises(ModelError) as error:
        load_network(spec or str(path), None)
    assert "\n" not in str(error.value)
    return str(error.value)


def constant(name: str, values: Any) -> Any:
    tensor = numpy_helper.from_array(np.array(values), f"{name}_value")
    return helper.make_node("Constant", [], [name], value=tensor)


def cut_everywhere(network: Network, x: torch.Tensor) -> torch.Tensor:
    """The network's output, which is the same to the bit when it is cut at any node."""
    with torch.no_grad():
        whole: torch.Tensor = network.module(x)
        for name, _ in network.module.named_children():
            with Split(network.module, name) as split:
                assert torch.equal(split.rear(split.front(x)), whole), name
    return whole


@pytest.mark.parametrize("shape", [(1, 3, 32, 48), ("n", 3, "h", None), (1, 32, 48, 3)])
def test_a_network_is_exact_wherever_it_is_cut(shape: tuple[Any, ...], tmp_path: Path) -> None:
    network = load_network(str(write_network(tmp_path / "net.onnx", shape=shape)), None)
    assert network.definition.layers[0] == "Relu_d"
    x = IMAGE.permute(0, 2, 3, 1).contiguous() if shape[3] == 3 else IMAGE
    cut_everywhere(network, x)
    assert "agrees with onnxruntime" in network.verify((x,))[0]


def test_a_wrong_conversion_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    right = OPERATORS["Resize"]
    monkeypatch.setitem(OPERATORS, "Resize", lambda node, options: right(node, options).flip(3))
    network = load_network(str(write_network(tmp_path / "net.onnx")), None)
    with pytest.raises(ModelError):
        network.verify((IMAGE,))


def test_a_free_size_is_a_multiple_of_the_patches_of_a_vision_transformer(tmp_path: Path) -> None:
    nodes = (
        constant("w", np.zeros((1, 1, 14, 14), np.float32)),
        helper.make_node("Conv", ["depth", "w"], ["out"], kernel_shape=[14] * 2, strides=[14] * 2),
    )
    path = write_network(tmp_path / "x.onnx", shape=(1, 3, "h", "w"), nodes=nodes, outputs=("out",))
    assert load_network(str(path), None).definition.size == Multiple(14)


def test_what_is_no_network_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "net.onnx"
    refused(path)
    path.touch()
    os.truncate(path, 2**31 + 1)  # without a byte on the disk
    refused(path)
    named = write_network(path).read_bytes()
    for content in (b"not a network", b"", named.replace(b"Sigmoid", b"\xffigmoid")):
        path.write_bytes(content)
        refused(path)


QUANTISED = helper.make_node("DynamicQuantizeLinear", ["depth"], ["q", "scale", "zero"])


@pytest.mark.parametrize(
    ("stated", "message"),
    [
        ({"nodes": (QUANTISED,), "outputs": ("scale",)}, "DynamicQuantizeLinear"),
        ({"domain": "com.microsoft"}, "com.microsoft.Add"),
        ({"opset": 99}, "99"),
        ({"shape": (1, 4, 32, 48)}, "1×4×32×48"),
        ({"shape": (2, 3, 32, 48)}, "2×3×32×48"),
        ({"shape": (1, 3, 10**6, 10**6)}, "pixels"),
        ({"shape": (1, 3, 7000, 9000)}, "--max-pixels"),
    ],
)
def test_other_networks_are_refused(stated: dict[str, Any], message: str, tmp_path: Path) -> None:
    with little():
        assert message in refused(write_network(tmp_path / "net.onnx", **stated))


def test_several_outputs_are_listed_and_one_can_be_named(tmp_path: Path) -> None:
    path = write_network(tmp_path / "net.onnx", outputs=("g", "depth"))
    assert f"2 outputs; name the depth as {path}:g" in refused(path)
    refused(path, f"{path}:x")
    for name in ("depth", "g"):
        assert "agrees with onnxruntime" in load_network(f"{path}:{name}", None).verify((IMAGE,))[0]


def test_arithmetic_on_shapes_is_no_layer_and_leaves_the_cut_exact(tmp_path: Path) -> None:
    nodes = (
        helper.make_node("Shape", ["depth"], ["shape"], "shape/read"),
        constant("twice", [1, 1, 2, 2]),
        helper.make_node("Mul", ["shape", "twice"], ["size"], "shape/times"),
        helper.make_node("Resize", ["depth", "", "", "size"], ["big"], "big/up", mode="linear"),
        helper.make_node("GlobalAveragePool", ["d"], ["pooled"], "side/pool"),
        helper.make_node("ReduceMean", ["pooled"], ["mean"], "side/mean", axes=[1]),
        helper.make_node("Add", ["big", "mean"], ["out"], "big/add"),
    )
    shape = (1, 3, None, None)
    path = write_network(tmp_path / "net.onnx", shape=shape, nodes=nodes, outputs=("out",))
    network = load_network(str(path), None)
    names = [name for name, _ in network.module.named_children()]
    # in the file's order, though the side's nodes could be run before
    assert names[-4:] == ["big/up", "side/pool", "side/mean", "big/add"]
    assert not any(name.startswith("shape/") for name in names)
    for height, width in ((32, 48), (64, 32)):
        whole = cut_everywhere(network, IMAGE.repeat(1, 1, 2, 1)[..., :height, :width])
        assert whole.shape[-2:] == (2 * height, 2 * width)
    # on another device the sizes stay where Python reads them
    assert network.module.to("meta")(IMAGE.to("meta")).shape == (1, 1, 64, 96)


Change = Callable[[Any], object]


def edited(path: Path, change: Change) -> Path:
    model = onnx.load(write_network(path))
    change(model)
    onnx.save(model, path)
    return path


def reads(name: str) -> Change:
    return lambda model: model.graph.node[0].input.__setitem__(0, name)


def claims(*dims: int) -> Change:
    return lambda model: model.graph.initializer[0].dims.__setitem__(slice(None), dims)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        *((reads(name), "'enc/conv.1'") for name in ("nowhere", "a", "e")),
        *((claims(*dims), "'w1'") for dims in ([4], [2**62] * 20)),
        (lambda m: m.functions.add(name="f"), "functions"),  # which may call each other for ever
        (lambda m: setattr(m.graph.initializer[0], "data_type", 10), "float32"),  # in float16
    ],
)
def test_broken_graphs_are_refused(change: Change, message: str, tmp_path: Path) -> None:
    assert message in refused(edited(tmp_path / "a.onnx", change))


WORK = {
    "a constant": [
        constant("n", [100_000, 100_000]), helper.make_node("ConstantOfShape", ["n"], ["big"]),
    ],
    "constants": [
        constant("d0", [1.0]),
        *(helper.make_node("Concat", [f"d{n}"] * 2, [f"d{n + 1}"], axis=0) for n in range(34)),
        helper.make_node("Identity", ["d34"], ["big"]),
    ],
    "Resize": [
        constant("s", np.float32([1, 1, 1000, 1000])),
        helper.make_node("Resize", ["depth", "", "s"], ["big"], mode="linear"),
    ],
    "sums": [
        constant("n", [4096, 4096]),
        helper.make_node("ConstantOfShape", ["n"], ["a1"]),
        *(helper.make_node("ReduceSum", ["a1"], [f"r{n}"], keepdims=0) for n in range(2000)),
        helper.make_node("Sum", [f"r{n}" for n in range(2000)], ["big"]),
    ],
}  # fmt: skip


@pytest.mark.parametrize("kind", WORK)
def test_far_more_memory_or_work_than_networks_need_is_refused(kind: str, tmp_path: Path) -> None:
    tail = (
        helper.make_node("ReduceSum", ["big"], ["small"], keepdims=0),
        helper.make_node("Mul", ["depth", "small"], ["out"]),
    )
    path = write_network(tmp_path / "x.onnx", nodes=(*WORK[kind], *tail), outputs=("out",))
    with little(megabytes=500, seconds=4):
        refused(path)


def beside(path: Path, *, copies: int = 0, dims: Any = (8, 3, 3, 3), **entry: object) -> Path:
    """A network whose first weights, and so many more, lie in a file beside it."""
    (path.parent / "weights.bin").write_bytes(bytes(range(216)) * 4)

    def change(model: Any) -> None:
        tensors = [model.graph.initializer[0]]
        tensors += [model.graph.initializer.add(name=f"t{n}", data_type=1) for n in range(copies)]
        for tensor in tensors:
            del tensor.dims[:]
            tensor.dims.extend(dims)
            tensor.ClearField("raw_data")
            tensor.data_location = onnx.TensorProto.EXTERNAL
            for key, value in ({"location": "weights.bin"} | entry).items():
                tensor.external_data.add(key=key, value=str(value))

    return edited(path, change)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        *(("location", path) for path in ("../secret.bin", "/etc/passwd", "link.bin", "", "fifo")),
        *(("offset", number) for number in (-4, 4, 2**62, "x")),
        *(("length", number) for number in (-1, 4, 2**62)),
        ("dims", (2**31, 2**31)),
        ("copies", 1000),
    ],
)
def test_weights_beside_it_stay_and_are_read_once(field: str, value: Any, tmp_path: Path) -> None:
    (tmp_path / "secret.bin").write_bytes(bytes(864))
    folder = tmp_path / "models"
    folder.mkdir()
    (folder / "link.bin").symlink_to(tmp_path / "secret.bin")
    os.mkfifo(folder / "fifo")
    with little():
        refused(beside(folder / "x.onnx", **{field: value}))


def test_weights_beside_the_model_are_those_of_one_file(tmp_path: Path) -> None:
    two = beside(tmp_path / "x.onnx", copies=1)
    (tmp_path / "one.onnx").write_bytes(onnx.load(str(two)).SerializeToString())
    one, other = (load_network(str(path), None) for path in (tmp_path / "one.onnx", two))
    assert torch.equal(one.module(IMAGE), other.module(IMAGE))
