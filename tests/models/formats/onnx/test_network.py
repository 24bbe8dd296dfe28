"""ONNX files as networks: named, cut, refined, checked against onnxruntime, or refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

pytest.importorskip("onnx", reason="needs the extra [onnx]")
pytest.importorskip("onnxruntime", reason="needs the extra [onnx]")

from onnx import helper

from pnpdepth_cli.core.refine import RefineSettings, refine
from pnpdepth_cli.core.split import Split
from pnpdepth_cli.errors import LayerError, ModelError, UsageError
from pnpdepth_cli.models.aligned import AlignedDepth
from pnpdepth_cli.models.formats.onnx.operators import OPERATORS
from pnpdepth_cli.models.network import load_network
from pnpdepth_cli.points import SparsePoints
from tests.models.formats.onnx.onnx_files import write_network


def picture(*shape: int) -> torch.Tensor:
    return torch.rand(shape, generator=torch.Generator().manual_seed(0))


def refused(path: Path, spec: str | None = None) -> str:
    with pytest.raises(ModelError) as error:
        load_network(spec or str(path), None)
    assert "\n" not in str(error.value)
    return str(error.value)


def test_layers_are_the_graphs_nodes_and_the_bottleneck_comes_first(tmp_path: Path) -> None:
    network = load_network(str(write_network(tmp_path / "net.onnx")), None)
    names = [name for name, _ in network.module.named_children()]
    assert names == ["enc/conv.1", "enc/relu.1", "enc/conv.2", "Relu_d", "dec/conv", "dec/up",
                     "dec/sigmoid", "dec/scale", "dec/shift"]  # fmt: skip
    assert network.definition.layers[0] == "Relu_d"
    assert network.checkpoint == tmp_path / "net.onnx"


@pytest.mark.parametrize("channels_last", [False, True])
def test_a_cut_at_any_node_gives_the_network_bit_for_bit(
    tmp_path: Path, channels_last: bool
) -> None:
    shape = (1, 32, 48, 3) if channels_last else (1, 3, 32, 48)
    path = write_network(tmp_path / "net.onnx", shape=shape, channels_last=channels_last)
    module = load_network(str(path), None).module
    x = picture(*shape)
    with torch.no_grad():
        whole = module(x)
        for name, _ in module.named_children():
            with Split(module, name) as split:
                assert torch.equal(split.rear(split.front(x)), whole), name


@pytest.mark.parametrize("shape", [(1, 3, 32, 48), ("n", 3, "h", "w"), (1, 3, None, None)])
def test_fixed_and_free_input_sizes_agree_with_onnxruntime(
    tmp_path: Path, shape: tuple[object, ...]
) -> None:
    network = load_network(str(write_network(tmp_path / "net.onnx", shape=shape)), None)
    assert network.definition.verify is not None
    said = network.definition.verify(network.module, (picture(1, 3, 32, 48),))
    assert "agrees with onnxruntime" in said


def test_a_wrong_reading_is_refused_with_the_first_node_that_differs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    right = OPERATORS["Resize"]
    monkeypatch.setitem(OPERATORS, "Resize", lambda node, given: right(node, given).flip(3))
    network = load_network(str(write_network(tmp_path / "net.onnx")), None)
    assert network.definition.verify is not None
    with pytest.raises(ModelError, match=r"first node that differs is 'dec/up' \(OnnxNode\(Resize"):
        network.definition.verify(network.module, (picture(1, 3, 32, 48),))


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_an_inverse_depth_of_either_sign_is_aligned_and_refined(
    tmp_path: Path, sign: float
) -> None:
    network = load_network(str(write_network(tmp_path / "net.onnx", sign=sign)), None)
    with torch.no_grad():
        raw = network.module(picture(1, 3, 32, 48))
    places = torch.randperm(32 * 48, generator=torch.Generator().manual_seed(1))[:80]
    near = raw.abs().flatten()[places]
    true = 1 / (near - 0.9 * near.min())
    points = SparsePoints(
        xy=torch.stack([places % 48, places // 48], dim=1).float(), depth=true, size=(32, 48)
    )
    depth_of = AlignedDepth(network, points, "auto")
    with Split(network.module, network.definition.layers[0]) as split:
        result = refine(
            split, (picture(1, 3, 32, 48),), points, RefineSettings(iterations=3),
            depth_of=depth_of,
        )  # fmt: skip
    assert depth_of.alignment is not None
    assert (depth_of.alignment.space, depth_of.alignment.kind) == ("inverse", "affine")
    assert depth_of.alignment.falling == (sign > 0)
    assert torch.allclose(points.sample(result.before), true, rtol=1e-3)


def test_fastdepth_reproduces_its_published_prediction_and_is_refined(shared_data: Path) -> None:
    network = load_network(str(shared_data / "weights" / "fastdepth_nyu.onnx"), None)
    nyu = shared_data / "nyu"
    rgb = torch.from_numpy(np.load(nyu / "rgb.npy").transpose(2, 0, 1)[None]).float()
    published = torch.from_numpy(np.load(nyu / "pred.npy"))
    truth = torch.from_numpy(np.load(nyu / "depth.npy")).float().reshape(224, 224)
    with torch.no_grad():
        assert float((network.module(rgb) - published).abs().mean()) < 1e-5
    assert network.definition.verify is not None
    network.definition.verify(network.module, (rgb,))
    places = torch.randperm(224 * 224, generator=torch.Generator().manual_seed(0))[:200]
    points = SparsePoints(
        xy=torch.stack([places % 224, places // 224], dim=1).float(),
        depth=truth.flatten()[places], size=(224, 224),
    )  # fmt: skip
    settings = RefineSettings(iterations=5, lr="3%", update="adam")
    with Split(network.module, network.definition.layers[0]) as split:
        result = refine(split, (rgb,), points, settings, depth_of=network.depth_of)
    before, after = (float((d[0, 0] - truth).abs().mean()) for d in (result.before, result.after))
    assert after < 0.8 * before


def test_what_is_no_network_is_refused(tmp_path: Path) -> None:
    assert "does not exist" in refused(tmp_path / "no.onnx")
    (tmp_path / "bad.onnx").write_bytes(b"not a network")
    assert "cannot be read" in refused(tmp_path / "bad.onnx")
    (tmp_path / "empty.onnx").write_bytes(b"")
    assert "holds no graph" in refused(tmp_path / "empty.onnx")


def test_operators_that_are_not_covered_are_named(tmp_path: Path) -> None:
    node = helper.make_node("NonZero", ["depth"], ["where"])
    path = write_network(tmp_path / "net.onnx", nodes=(node,), outputs=("where",))
    assert "NonZero (1 ×)" in refused(path)
    path = write_network(tmp_path / "net.onnx", domain="com.microsoft")
    assert "com.microsoft.Add" in refused(path)


def test_an_opset_from_the_future_is_refused(tmp_path: Path) -> None:
    assert "opset 99" in refused(write_network(tmp_path / "net.onnx", opset=99))


def test_several_outputs_are_listed_and_one_can_be_named(tmp_path: Path) -> None:
    path = write_network(tmp_path / "net.onnx", outputs=("depth", "g"))
    said = refused(path)
    assert "2 outputs" in said
    assert "depth" in said
    assert f"{path}:depth" in said
    assert "no output 'x'" in refused(path, f"{path}:x")
    assert load_network(f"{path}:g", None).module.output_names == ("g",)


@pytest.mark.parametrize("shape", [(1, 4, 32, 48), (2, 3, 32, 48), (1, 3, 32)])
def test_what_takes_no_single_rgb_picture_is_refused(
    tmp_path: Path, shape: tuple[int, ...]
) -> None:
    said = refused(write_network(tmp_path / "net.onnx", shape=shape))
    assert "×".join(map(str, shape)) in said


def test_a_layer_without_gradient_is_named(tmp_path: Path) -> None:
    node = helper.make_node("Round", ["depth"], ["rounded"], "round")
    path = write_network(tmp_path / "net.onnx", nodes=(node,), outputs=("rounded",))
    network = load_network(str(path), None)
    assert network.definition.layers == ()


def test_a_checkpoint_beside_an_onnx_file_is_refused(tmp_path: Path) -> None:
    path = write_network(tmp_path / "net.onnx")
    with pytest.raises(UsageError, match="comes with its weights"):
        load_network(str(path), path)


def test_an_unknown_node_is_refused_with_near_names(tmp_path: Path) -> None:
    module = load_network(str(write_network(tmp_path / "net.onnx")), None).module
    with pytest.raises(LayerError, match=r"dec/conv"):
        Split(module, "dec/conb")


def test_the_definition_can_be_changed_like_any_other(tmp_path: Path) -> None:
    definition = load_network(str(write_network(tmp_path / "net.onnx")), None).definition
    assert definition.default_alignment == "auto"
    assert (
        replace(definition, output_kind="depth", output_scale="metric").default_alignment == "none"
    )


def test_arithmetic_on_shapes_is_no_layer_and_leaves_the_cut_exact(tmp_path: Path) -> None:
    by = helper.make_tensor("value", 7, [4], [1, 1, 2, 2])
    nodes = (
        helper.make_node("Shape", ["depth"], ["shape"], "shape/read"),
        helper.make_node("Constant", [], ["twice"], "shape/by", value=by),
        helper.make_node("Mul", ["shape", "twice"], ["size"], "shape/times"),
        helper.make_node("Resize", ["depth", "", "", "size"], ["big"], "big/up", mode="linear"),
        helper.make_node("Shape", ["d"], ["coarse"], "shape/coarse"),
        helper.make_node("Reshape", ["d", "coarse"], ["same"], "side/reshape"),
        helper.make_node("GlobalAveragePool", ["same"], ["pooled"], "side/pool"),
        helper.make_node("ReduceMean", ["pooled"], ["mean"], "side/mean", axes=[1]),
        helper.make_node("Add", ["big", "mean"], ["out"], "big/add"),
    )
    shape = (1, 3, None, None)
    path = write_network(tmp_path / "net.onnx", shape=shape, nodes=nodes, outputs=("out",))
    network = load_network(str(path), None)
    names = [name for name, _ in network.module.named_children()]
    assert not any(name.startswith("shape/") for name in names)
    for height, width in ((32, 48), (64, 32)):
        x = picture(1, 3, height, width)
        with torch.no_grad():
            whole = network.module(x)
            assert whole.shape[-2:] == (2 * height, 2 * width)
            for name in names:
                with Split(network.module, name) as split:
                    z = split.front(x)
                    assert torch.equal(split.rear(z), whole), name
                    assert torch.equal(split.rear(z), whole), name
    assert network.definition.verify is not None
    network.definition.verify(network.module, (picture(1, 3, 32, 48),))
