"""torch.export archives and bare Python classes as networks."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from torch import nn

from pnpdepth_cli.core.split import Split
from pnpdepth_cli.errors import CheckpointError, ModelError
from pnpdepth_cli.models.definition import Fixed
from pnpdepth_cli.models.network import load_network
from pnpdepth_cli.models.registry import find_definition


class Net(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.encode = nn.Sequential(
            nn.Conv2d(3, 8, 3, 2, 1), nn.BatchNorm2d(8), nn.ReLU(inplace=True)
        )
        self.middle, self.decode = nn.Conv2d(8, 8, 3, 2, 1), nn.Conv2d(8, 1, 3, 1, 1)

    def forward(self, rgb: torch.Tensor) -> torch.Tensor:
        z = torch.relu(self.middle(self.encode(rgb)))
        up = nn.functional.interpolate(self.decode(z), scale_factor=4, mode="bilinear")
        return 1 + 2 * torch.sigmoid(up)


def test_an_exported_program_is_cut_at_its_graphs_nodes_bit_for_bit(tmp_path: Path) -> None:
    torch.manual_seed(0)
    net, x = Net().eval(), torch.rand(1, 3, 32, 48)
    torch.export.save(torch.export.export(net, (x,)), tmp_path / "net.pt2")
    network = load_network(str(tmp_path / "net.pt2"), None)
    assert network.definition.size == Fixed(32, 48)
    assert network.definition.layers[0] == "relu"
    with torch.no_grad():
        whole = net(x)
        assert torch.equal(network.raw_of(network.module(x)), whole)
        names = [name for name, _ in network.module.named_children()]
        assert {"conv2d", "batch_norm", "relu_", "sigmoid"} <= set(names)
        for name in names:
            with Split(network.module, name) as split:
                assert torch.equal(network.raw_of(split.rear(split.front(x))), whole), name


def test_what_is_no_exported_program_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match="does not exist"):
        find_definition(str(tmp_path / "no.pt2"))
    (tmp_path / "bad.pt2").write_bytes(b"no archive")
    with pytest.raises(ModelError, match=r"torch\.export\.save"):
        find_definition(str(tmp_path / "bad.pt2"))


@pytest.mark.parametrize("suffix", [".pt", ".pth", ".torchscript", ".safetensors", ".pth.tar"])
def test_weights_as_a_model_are_refused_with_a_remedy(suffix: str) -> None:
    with pytest.raises(ModelError, match=r"--checkpoint.*ONNX"):
        find_definition(f"net{suffix}")


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_a_torchscript_archive_and_a_pickled_module_are_named_with_the_lines_that_export_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("onnx", reason="needs the extra [onnx]")
    torch.jit.save(torch.jit.script(Net()), tmp_path / "script.pt")
    torch.save(Net(), tmp_path / "module.pth")
    torch.save(Net().state_dict(), tmp_path / "weights.pth")
    monkeypatch.chdir(tmp_path)
    for name, what in (("script.pt", "a TorchScript archive"), ("module.pth", "pickled module")):
        with pytest.raises(ModelError, match=what) as error:
            find_definition(name)
        lines = str(error.value).partition("images): ")[2].replace("480, 640", "32, 48")
        exec(lines, {"torch": torch})
        network = load_network(f"{Path(name).stem}.onnx", None)
        assert network.definition.size == Fixed(32, 48)
    with pytest.raises(ModelError, match=r"a file of weights.*--checkpoint"):
        find_definition("weights.pth")


BARE = """
import torch
from torch import nn

class Block(nn.Module):
    def __init__(self, channels=4):
        super().__init__()
        self.conv = nn.Conv2d(channels, channels, 3, 2, 1)
    def forward(self, x):
        return torch.relu(self.conv(x))

class Net(nn.Module):
    def __init__(self):
        super().__init__()
        self.inward, self.block, self.out = nn.Conv2d(3, 4, 3, 2, 1), Block(), nn.Conv2d(4, 1, 1)
    def forward(self, rgb):
        y = nn.functional.interpolate(self.out(self.block(self.inward(rgb))), scale_factor=4)
        return 1 + torch.sigmoid(y)

def make():
    return Net()

def needs(width):
    return Net()
"""


@pytest.mark.parametrize("attribute", ["", ":Net", ":make"])
def test_a_bare_class_or_factory_is_a_network_and_its_assumptions_are_printed(
    tmp_path: Path, attribute: str
) -> None:
    file = tmp_path / "bare.py"
    file.write_text(BARE)
    spec = f"{file}{attribute}"
    with pytest.raises(CheckpointError, match="--checkpoint"):
        load_network(spec, None)
    torch.save(find_definition(spec).build().state_dict(), tmp_path / "w.pt")
    network = load_network(spec, tmp_path / "w.pt")
    assert network.definition.layers[0] == "block"
    assert network.definition.default_alignment == "auto"
    assert "assumed: one rgb image in" in network.notes[0]


def test_a_factory_that_needs_arguments_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "bare.py"
    file.write_text(BARE)
    with pytest.raises(ModelError, match=r"needs arguments \(width\)"):
        find_definition(f"{file}:needs")
