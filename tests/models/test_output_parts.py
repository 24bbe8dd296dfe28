"""A part of an output, named behind the file of a network."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch

from pnpdepth_cli.errors import ModelError
from pnpdepth_cli.models.network import load_network
from pnpdepth_cli.models.output_parts import part_of, split_parts

HEIGHT, WIDTH = 5, 7
MAPS = torch.arange(3.0 * HEIGHT * WIDTH).reshape(1, 3, HEIGHT, WIDTH)


@pytest.mark.parametrize(
    ("spec", "base", "parts"),
    [
        ("net.onnx:points[z]", "net.onnx:points", ("z",)),
        ("a b/net.onnx:points[0][2]", "a b/net.onnx:points", ("0", "2")),
        ("net.pt2:[1]", "net.pt2", ("1",)),
        ("net.py:Net[depth]", "net.py:Net", ("depth",)),
        ("folder:[predicted_depth]", "folder", ("predicted_depth",)),
        ("net[1].onnx", "net[1].onnx", ()),
        ("net.onnx:out", "net.onnx:out", ()),
    ],
)
def test_the_parts_of_an_output_are_named_behind_a_colon(
    spec: str, base: str, parts: tuple[str, ...]
) -> None:
    assert split_parts(spec) == (base, parts)


@pytest.mark.parametrize(
    "output", [MAPS, MAPS[0], MAPS.permute(0, 2, 3, 1), MAPS[None].permute(0, 1, 3, 4, 2)]
)
def test_a_channel_is_found_first_or_last(output: torch.Tensor) -> None:
    for key, number in (("0", 0), ("2", 2), ("z", 2), ("x", 0)):
        assert torch.equal(part_of(output, key), MAPS[:, number : number + 1])
    for key in ("3", "w", "-1"):
        with pytest.raises(ModelError, match="x, y, z"):
            part_of(output, key)


@pytest.mark.parametrize(
    ("output", "part", "known"),
    [([1], "1", "0 to 0"), ({"a": 1}, "b", "a"), (3, "0", "int"), (MAPS[:, :2], "z", "0 to 1")],
)
def test_a_part_that_is_not_there_is_refused_with_those_that_are(
    output: Any, part: str, known: str
) -> None:
    with pytest.raises(ModelError, match=known):
        part_of(output, part)


NETWORK = """
import torch
from torch import nn

class Net(nn.Module):
    def __init__(self):
        super().__init__()
        self.encode = nn.Conv2d(3, 8, 3, 2, 1)
        self.decode = nn.ConvTranspose2d(8, 3, 2, 2)
    def forward(self, rgb):
        points = self.decode(self.encode(rgb))
        return GIVES
"""


@pytest.mark.parametrize(
    ("gives", "part", "channel"),
    [
        ("points", ":Net[z]", 2),
        ("points.permute(0, 2, 3, 1)", ":Net[1]", 1),
        ("[rgb, points]", ":Net[1][z]", 2),
        ("{'confidence': rgb, 'points': points}", ":Net[points][0]", 0),
    ],
)
def test_a_part_of_a_network_of_a_python_file_is_its_prediction(
    gives: str, part: str, channel: int, tmp_path: Path
) -> None:
    path = tmp_path / "net.py"
    path.write_text(NETWORK.replace("GIVES", gives))
    torch.manual_seed(0)
    weights = tmp_path / "net.pt"
    made: dict[str, Any] = {}
    exec(path.read_text(), made)
    torch.save(made["Net"]().state_dict(), weights)
    network = load_network(f"{path}{part}", weights)
    image = torch.rand(1, 3, 32, 32)
    with torch.no_grad():
        given = network.module(image)
        points = network.module.decode(network.module.encode(image))
        assert torch.equal(network.raw_of(given), points[:, channel : channel + 1])
    with pytest.raises(ModelError, match=r"FILE:\[0\]"):
        load_network(f"{path}:Net", weights).raw_of(given)


@pytest.mark.parametrize("channels_last", [True, False])
def test_a_part_of_an_output_of_an_onnx_file_is_refined(
    channels_last: bool, tmp_path: Path
) -> None:
    pytest.importorskip("onnxruntime", reason="needs the extra [onnx]")
    from onnx import helper

    from tests.models.onnx.onnx_files import write_network

    nodes = (helper.make_node("Concat", ["depth", "depth", "g"], ["points"], "join", axis=1),)
    if channels_last:
        nodes += (helper.make_node("Transpose", ["points"], ["last"], "turn", perm=[0, 2, 3, 1]),)
    name = "last" if channels_last else "points"
    path = write_network(tmp_path / "net.onnx", nodes=nodes, outputs=(name, "g"))
    image = torch.rand(1, 3, 32, 48)
    whole, part = (load_network(f"{path}:{output}", None) for output in ("g", f"{name}[z]"))
    with torch.no_grad():
        expected, found = (loaded.raw_of(loaded.module(image)) for loaded in (whole, part))
    assert torch.equal(found, expected)
    assert "agrees with onnxruntime" in part.verify((image,))[0]


def test_an_element_of_the_outputs_of_an_archive_is_its_prediction(tmp_path: Path) -> None:
    made: dict[str, Any] = {}
    exec(NETWORK.replace("GIVES", "(rgb + 1, points)"), made)
    image = torch.rand(1, 3, 32, 32)
    torch.export.save(torch.export.export(made["Net"](), (image,)), tmp_path / "net.pt2")
    network = load_network(f"{tmp_path}/net.pt2:[1][z]", None)
    with torch.no_grad():
        given = network.module(image)
    assert torch.equal(network.raw_of(given), given[1][:, 2:])
