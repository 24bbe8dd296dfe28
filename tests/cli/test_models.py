"""`models` and `layers` from the command line."""

from __future__ import annotations

import json

import pytest

from pnpdepth_cli.cli.main import run
from tests.commands.frames import FrameOnDisk


def test_networks_are_listed(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["models"]) == 0
    assert {"sparse2dense-kitti", "sparse2dense-tiny"} <= set(capsys.readouterr().out.split())


def layers(frame: FrameOnDisk, *options: str) -> list[str]:
    network = ["--model", str(frame.model), "--checkpoint", str(frame.checkpoint)]
    return ["layers", *network, "--all", *options]


def test_layers_are_listed_with_why_one_cannot_be_cut_at(
    frame: FrameOnDisk, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(layers(frame, "--json")) == 0
    problems = {row["name"]: row["problem"] for row in json.loads(capsys.readouterr().out)}
    assert set(problems) == {"encode", "encode.0", "encode.1", "middle", "unused", "decode"}
    assert problems["unused"]
    assert not problems["middle"]


def test_the_table_of_layers_says_what_its_json_says(
    frame: FrameOnDisk, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(layers(frame, "--json")) == 0
    problems = {row["name"]: row["problem"] for row in json.loads(capsys.readouterr().out)}
    assert run(layers(frame)) == 0
    lines = capsys.readouterr().out.splitlines()
    shown = {words[0]: words[1:] for words in map(str.split, lines) if words}
    assert shown["unused"] == ["–", *problems["unused"].split()]


@pytest.fixture
def onnx_file(frame: FrameOnDisk) -> str:
    pytest.importorskip("onnxruntime", reason="needs the extra [onnx]")
    from tests.models.onnx.onnx_files import write_network

    return str(write_network(frame.folder / "net.onnx"))


def test_onnx_is_refined_and_compared_with_onnxruntime(
    frame: FrameOnDisk, onnx_file: str, capsys: pytest.CaptureFixture[str]
) -> None:
    files = [str(frame.image), "--sparse", str(frame.sparse), "-o", str(frame.folder / "o.exr")]
    assert run(["refine", *files, "--model", onnx_file, "--iterations", "2", "--json"]) == 0
    record = json.loads(capsys.readouterr().out)
    assert record["result"]["settings"]["layer"] == "Relu_d"
    assert any("onnxruntime" in note for note in record["notes"])


def test_onnx_is_checked_at_every_layer(
    frame: FrameOnDisk, onnx_file: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["models", "check", onnx_file, "--image", str(frame.image)]) == 0
    checked = json.loads(capsys.readouterr().out)
    assert set(checked["layers"].values()) == {"ok"}
    assert any("'unit'" in note for note in checked["notes"])


@pytest.mark.parametrize("value", ["inf", "nan"])
@pytest.mark.parametrize("method", ["fused", "alone", "paper"])
def test_a_network_that_gives_no_number_is_named_a_fault_of_the_network(
    method: str, value: str, frame: FrameOnDisk, capsys: pytest.CaptureFixture[str]
) -> None:
    text = frame.model.read_text().replace("definition = ", "definition = whole = ")
    text += f"""
import dataclasses, torch
class Blind(torch.nn.Module):
    def __init__(self):
        super().__init__()
        self.middle = torch.nn.Conv2d(3, 1, 1)
    def forward(self, rgb, *others):
        return self.middle(rgb) + float("{value}")
definition = dataclasses.replace(whole, build=Blind, complete=True, layers=("middle",))
"""
    (frame.folder / "blind.py").write_text(text)
    network = ["--model", str(frame.folder / "blind.py"), "--method", method]
    files = [str(frame.image), "--sparse", str(frame.sparse), "-o", str(frame.folder / "o.exr")]
    assert run(["refine", *files, *network]) == 4
    assert "not finite at any" in capsys.readouterr().err.splitlines()[-1]
    assert run(["models", "check", network[1]]) == 0
    assert "warning: the prediction is inf or NaN" in capsys.readouterr().out
