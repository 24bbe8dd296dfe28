"""The commands with networks that are no definition of ours."""

from __future__ import annotations

import json

import pytest

from tests.cli.test_commands import code_of
from tests.commands.frames import FrameOnDisk


def test_an_onnx_file_is_refined_and_checked(
    frame: FrameOnDisk, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("onnxruntime", reason="needs the extra [onnx]")
    from tests.models.onnx.onnx_files import write_network

    net = str(write_network(frame.folder / "net.onnx"))
    out = frame.folder / "o.exr"
    arguments = ["refine", str(frame.image), "--sparse", str(frame.sparse), "--model", net]
    assert code_of([*arguments, "-o", str(out), "--iterations", "2", "--json"]) == 0
    record = json.loads(capsys.readouterr().out)
    assert record["settings"]["layer"] == "Relu_d"
    assert any("agrees with onnxruntime" in note for note in record["notes"])
    assert any("rgb range" in note for note in record["notes"])
    assert len(record["model"]["checkpoint_sha256"]) == 64
    assert code_of(["models", "check", net, "--image", str(frame.image), "--json"]) == 0
    layers = json.loads(capsys.readouterr().out)
    assert set(layers["layers"].values()) == {"ok"}
