"""The commands with networks that are no definition of ours."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file
from torch import nn

from tests.cli.test_commands import code_of, refine
from tests.commands.frames import FrameOnDisk


def test_an_unaligned_network_is_aligned_and_recorded(
    frame: FrameOnDisk, capsys: pytest.CaptureFixture[str]
) -> None:
    source = frame.model.read_text()
    wrong = frame.folder / "wrong.py"
    wrong.write_text(source.replace("return 2 + 3 *", "return -50 * (2 + 3 *").replace(
        "(self.encode(rgb))))", "(self.encode(rgb)))))"))  # fmt: skip
    options = ("--json", "--iterations", "0", "--overwrite")
    plain = refine(frame, "--model", str(wrong), *options)
    assert code_of(plain) == 0
    record = json.loads(capsys.readouterr().out)
    assert record["alignment"] is None
    assert any(note.startswith("warning") and "--align auto" in note for note in record["notes"])
    for kind in ("scale", "affine", "median", "auto"):
        assert code_of([*plain, "--align", kind]) == 0
        record = json.loads(capsys.readouterr().out)
        assert (record["alignment"]["scale"] < 0) or kind in ("affine", "auto")
        assert record["settings"]["align"] == kind
        assert record["sparse_error"]["before"]["mae"] < 1
        assert any(note.startswith("alignment") for note in record["notes"])


def test_align_every_fits_at_each_update(
    frame: FrameOnDisk, capsys: pytest.CaptureFixture[str]
) -> None:
    fits = {}
    for more in ([], ["--set", "align-every"]):
        arguments = [*refine(frame, "--align", "scale", "--json", "--overwrite", *more)]
        assert code_of(arguments) == 0
        record = json.loads(capsys.readouterr().out)
        fits[bool(more)] = record["alignment"]["scale"]
        assert record["loss"][-1] < record["loss"][0]
    assert fits[True] != fits[False]


def test_an_onnx_file_is_refined_layers_listed_and_checked(
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
    assert code_of(["layers", "--model", net, "--json", "--sparse", str(frame.sparse)]) == 0
    rows = json.loads(capsys.readouterr().out)
    assert sorted(row["rank"] for row in rows) == list(range(1, len(rows) + 1))
    assert all(row["seconds_behind"] > 0 for row in rows)
    assert code_of(["layers", "--model", net, "--sparse", str(frame.sparse)]) == 0
    assert "pixels apart" in capsys.readouterr().out
    assert code_of(["models", "check", net, "--image", str(frame.image), "--json"]) == 0
    layers = json.loads(capsys.readouterr().out)
    assert set(layers["layers"].values()) == {"ok"}
    assert code_of(["models", "check", net]) == 0
    assert "Relu_d: ok" in capsys.readouterr().out


def test_a_published_checkpoint_is_converted_and_nothing_is_replaced(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    net = nn.Sequential(nn.Conv2d(1, 2, 3), nn.BatchNorm2d(2))
    source, target = tmp_path / "m.pth.tar", tmp_path / "w.safetensors"
    torch.save({"args": argparse.Namespace(a=1), "epoch": 2, "model": net}, source)
    convert = ["models", "convert", str(source), str(target)]
    assert code_of([*convert, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["tensors"] == 7
    state = load_file(target)
    assert all(torch.equal(state[name], value) for name, value in net.state_dict().items())
    assert code_of(convert) == 2
    assert code_of(["models", "convert", str(source), str(tmp_path / "w.pt")]) == 2
    assert (
        code_of(["models", "convert", str(tmp_path / "no.pt"), str(tmp_path / "x.safetensors")])
        == 4
    )
    assert "does not exist" in capsys.readouterr().err


def test_fetch_offline_is_an_error_of_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    hub = pytest.importorskip("huggingface_hub", reason="needs the extra [hf]")

    def refuse(*_: object, **__: object) -> None:
        raise ConnectionError("no route\nto host")

    monkeypatch.setattr(hub.HfApi, "model_info", refuse)
    fetch = ["models", "fetch", "org/name", "-o", str(tmp_path / "name")]
    assert code_of(fetch) == 4
    err = capsys.readouterr().err
    assert "no route to host" in err
    assert err.count("\n") == 1
    assert not (tmp_path / "name").exists()
    assert code_of(["models", "fetch", "name"]) == 2
