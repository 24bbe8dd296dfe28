"""torch.export archives as networks; graphs of sparse depth and intrinsics, also of ONNX."""

from __future__ import annotations

import io
import json
import os
import re
import time
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn
from torch.export import Dim

from pnpdepth_cli.camera import Camera
from pnpdepth_cli.core.split import Split
from pnpdepth_cli.errors import ModelError, UsageError
from pnpdepth_cli.frames.frame import Frame
from pnpdepth_cli.frames.open_network import prepare
from pnpdepth_cli.models.definition import Fixed, ModelDefinition, Multiple, Normalisation
from pnpdepth_cli.models.network import load_network
from pnpdepth_cli.models.onnx import onnx_definition
from pnpdepth_cli.models.registry import find_definition
from pnpdepth_cli.models.torch_export import exported_definition
from pnpdepth_cli.points import SparsePoints
from tests.models.weights.files import Hostile, little


class Net(nn.Module):
    """Layers in place, an equation, attention, constants, parts and infinite numbers."""

    def __init__(self) -> None:
        super().__init__()
        torch.manual_seed(0)
        layers = nn.Conv2d(3, 8, 3, 2, 1), nn.BatchNorm2d(8), nn.ReLU(inplace=True)
        self.encode = nn.Sequential(*layers)
        self.out = nn.Conv2d(8, 1, 1)
        self.levels = torch.arange(1, 9)

    def forward(self, rgb: Tensor) -> Tensor:
        z = torch.einsum("bchw,c->bchw", self.encode(rgb), self.levels.float())
        rows = z.flatten(2).transpose(1, 2)
        z = z + nn.functional.scaled_dot_product_attention(rows, rows, rows).mean()
        left, right = torch.split(self.out(z), [8, z.shape[3] - 8], dim=3)
        y = torch.cat([left, right.clamp(min=-float("inf"))], dim=3)
        y = nn.functional.interpolate(y, size=tuple(rgb.shape[2:]), mode="bilinear")
        return torch.ones(1, layout=torch.strided) + torch.sigmoid(torch.relu(y)) + rgb.mean()


@pytest.fixture(scope="module")
def archive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("archive") / "net.pt2"
    torch.export.save(torch.export.export(Net().eval(), (torch.rand(1, 3, 32, 48),)), path)
    return path


def test_an_exported_program_is_cut_at_its_graphs_nodes_bit_for_bit(archive: Path) -> None:
    network = load_network(str(archive), None)
    net = Net().eval()
    rgb = torch.rand(1, 3, 32, 48, requires_grad=True)
    assert network.definition.size == Fixed(32, 48)
    depth = network.raw_of(network.module(rgb))
    expected = net(rgb)
    assert torch.equal(depth, expected)
    ours, theirs = (torch.autograd.grad(output.sum(), rgb)[0] for output in (depth, expected))
    torch.testing.assert_close(ours, theirs)
    names = [name for name, _ in network.module.named_children()]
    assert {"conv2d", "batch_norm", "relu", "relu_", "sigmoid"} <= set(names)
    with torch.no_grad():
        for name in {*names} - {"split_with_sizes"}:  # which gives several
            with Split(network.module, name) as split:
                assert torch.equal(network.raw_of(split.rear(split.front(rgb))), expected), name


class WithPointsAndCamera(nn.Module):
    """Depth from an image, sparse depth and the camera's focal length and centre."""

    def __init__(self) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.layer = nn.Conv2d(4, 1, 3, 1, 1)

    def forward(self, rgb: Tensor, sparse: Tensor, intrinsics: Tensor) -> Tensor:
        depth = self.layer(torch.cat([rgb, sparse], dim=1)).sigmoid()
        return depth + intrinsics[:, :1, 2:, None] / intrinsics[0, 0, 0]


STATED: dict[str, Any] = {
    "input_kind": "rgb+sparse", "takes_intrinsics": True, "normalisation": Normalisation(),
    "output_kind": "depth", "output_scale": "metric",
}  # fmt: skip


@pytest.mark.parametrize("define", [onnx_definition, exported_definition])
def test_a_definition_names_a_graph_of_image_sparse_depth_and_intrinsics(
    define: Callable[..., ModelDefinition], tmp_path: Path, pytestconfig: pytest.Config
) -> None:
    if define is onnx_definition and pytestconfig.getoption("--rounding"):
        pytest.skip("torch's exporter would trace the other roundings")
    net = WithPointsAndCamera().eval()
    rgb = torch.rand(3, 20, 30)
    path = tmp_path / "net.pt2"
    given = (rgb[None], torch.zeros(1, 1, 20, 30), torch.eye(3)[None])
    if define is onnx_definition:
        pytest.importorskip("onnxruntime", reason="needs the extra [onnx]")
        path = tmp_path / "net.onnx"
        torch.onnx.export(net, given, str(path), dynamo=False)
    else:
        torch.export.save(torch.export.export(net, given), path)
    network = load_network(define(path, **STATED), None)
    # an image of twice the size, whose camera has half the focal length in the network's pixels
    points = SparsePoints(xy=torch.tensor([[4.5, 8.5]]), depth=torch.tensor([3.0]), size=(40, 60))
    camera = Camera(intrinsics=np.array([[50.0, 0, 29.5], [0, 60, 19.5], [0, 0, 1]]))
    frame = Frame(rgb=rgb.repeat_interleave(2, 1).repeat_interleave(2, 2), points=points)
    arguments = prepare(network, replace(frame, camera=camera)).arguments
    sparse = torch.zeros(1, 1, 20, 30)
    sparse[0, 0, 4, 2] = 3.0
    intrinsics = torch.tensor([[[25.0, 0, 14.5], [0, 30, 9.5], [0, 0, 1]]])
    for argument, right in zip(arguments[1:], (sparse, intrinsics), strict=True):
        torch.testing.assert_close(argument, right)
    with torch.no_grad():
        right = net(arguments[0], sparse, intrinsics)
        torch.testing.assert_close(network.raw_of(network.module(*arguments)), right)
    if define is onnx_definition:
        assert "agrees with onnxruntime" in network.verify(arguments)[0]
    with pytest.raises(UsageError):
        prepare(network, frame)
    with pytest.raises(ModelError):
        load_network(str(path), None)


def test_a_program_that_computes_sizes_is_refused_with_a_way_out(tmp_path: Path) -> None:
    sides = {2: 32 * Dim("rows", min=1, max=64), 3: 32 * Dim("columns", min=1, max=64)}
    for name, net in (("plain", nn.Conv2d(3, 1, 3, 1, 1)), ("computing", Net().eval())):
        program = torch.export.export(net, (torch.rand(1, 3, 64, 96),), dynamic_shapes=(sides,))
        torch.export.save(program, tmp_path / f"{name}.pt2")
    assert find_definition(str(tmp_path / "plain.pt2")).size == Multiple(32)
    with pytest.raises(ModelError, match="fixed sizes"):
        find_definition(str(tmp_path / "computing.pt2"))


MODEL = "models/model.json"
WEIGHTS = "data/weights/model_weights_config.json"
Change = Callable[[Any], object]


def rewritten(file: Path, entries: Mapping[str, bytes | Change], **how: Any) -> Path:
    """The archive with some entries replaced or added, or with their JSON changed."""
    target = file.with_name("changed.pt2")
    with zipfile.ZipFile(file) as source, zipfile.ZipFile(target, "w", **how) as changed:
        folder = f"{source.namelist()[0].partition('/')[0]}/"
        for name in {*source.namelist(), *(folder + name for name in entries)}:
            change = entries.get(name.removeprefix(folder)) or source.read(name)
            if callable(change):
                value = json.loads(source.read(name))
                change(value)
                change = json.dumps(value).encode()
            changed.writestr(name, change)
    return target


def first_node(**stated: object) -> Change:
    return lambda program: program["graph_module"]["graph"]["nodes"][0].update(stated)


def first_weight(**stated: object) -> Change:
    return lambda config: next(iter(config["config"].values())).update(stated)


def claims_much(config: Any) -> None:
    next(iter(config["config"].values()))["tensor_meta"]["sizes"] = [{"as_int": 10**12}] * 4


HOSTILE: dict[str, tuple[str, bytes | Change, str]] = {
    **{
        target: (MODEL, first_node(target=target), f"it calls '{target}'")
        for target in (
            "torch.os.system", "torch.ops.load_library", "torch.ops.aten.from_file.default",
            "_operator.methodcaller", "torch.ops.aten.__class__.mro",
            "torch.ops.aten.add.__call__", "torch.load",
            "torch.ops.higher_order.wrap_with_set_grad_enabled",
        )
    },
    "pickled weights": (WEIGHTS, first_weight(use_pickle=True), "is pickled"),
    "a large weight": (WEIGHTS, claims_much, "more than"),
    "a weight outside": (WEIGHTS, first_weight(path_name="../../../etc/hostname"), "KeyError"),
    "no JSON": (MODEL, b"[" * 100_000, "RecursionError"),
}  # fmt: skip


@pytest.mark.parametrize("kind", HOSTILE)
def test_what_could_do_more_than_compute_is_refused_in_one_line(archive: Path, kind: str) -> None:
    entry, change, message = HOSTILE[kind]
    with little(), pytest.raises(ModelError, match=rf"\A.*{re.escape(message)}.*\Z"):
        find_definition(str(rewritten(archive, {entry: change})))


def test_what_is_no_exported_program_is_refused(archive: Path, tmp_path: Path) -> None:
    (tmp_path / "bad.pt2").write_bytes(b"no archive")
    packed = rewritten(archive, {"data/x": bytes(10**7)}, compression=zipfile.ZIP_DEFLATED)
    for path in (tmp_path / "absent.pt2", tmp_path / "bad.pt2", packed):
        with pytest.raises(ModelError, match=path.name):
            find_definition(str(path))


def test_pickles_libraries_and_code_in_archives_stay_unread(archive: Path, tmp_path: Path) -> None:
    trap = tmp_path / "trap"
    pickled = io.BytesIO()
    torch.save((Hostile(os.mkdir, str(trap)),), pickled)
    code = f"__import__('os').mkdir({str(trap)!r})"

    def with_code(program: Any) -> None:
        program["guards_code"] = [code]
        program["range_constraints"][code] = {"min_val": 1, "max_val": 2}
        for value in program["graph_module"]["graph"]["sym_int_values"].values():
            value["as_expr"]["expr_str"] = code

    unread = ("sample_inputs/model.pt", "constants/custom_obj_0", "aotinductor/model/m.so")
    entries = {f"data/{entry}": pickled.getvalue() for entry in unread}
    network = load_network(str(rewritten(archive, {MODEL: with_code, **entries})), None)
    rgb = torch.rand(1, 3, 32, 48)
    assert torch.equal(network.module(rgb), load_network(str(archive), None).module(rgb))
    assert not trap.exists()


class Products(nn.Module):
    """A product of 4e12 multiplications, of a weight of a few bytes."""

    def __init__(self) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.ones(1, 16000))

    def forward(self, rgb: Tensor) -> Tensor:
        rows = self.weight.expand(16000, -1)
        return rgb[:, :1] + torch.mm(rows, rows.T)[0, 0]


def test_a_program_of_endless_products_is_refused_before_they_are_made(tmp_path: Path) -> None:
    file = tmp_path / "slow.pt2"
    # Exported on the meta device: nothing is multiplied here either.
    with torch.device("meta"):
        program = torch.export.export(Products().eval(), (torch.rand(1, 3, 32, 48),))
    program.state_dict["weight"] = nn.Parameter(torch.ones(1, 16000))
    torch.export.save(program, file)
    network = exported_definition(file).build()
    start = time.process_time()
    with pytest.raises(ModelError, match="arithmetic"):
        network(torch.rand(1, 3, 32, 48))
    assert time.process_time() - start < 10
