from __future__ import annotations

import json
import os
import subprocess
import sys

import pytest

from pnpdepth_cli.cli.main import run
from pnpdepth_cli.cli.options import request_of
from pnpdepth_cli.cli.refine_command import refine as refine_command
from tests.commands.frames import FrameOnDisk


def test_layers_says_why_a_layer_cannot_be_cut_at(
    frame: FrameOnDisk, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["layers", "--model", str(frame.model), "--checkpoint", str(frame.checkpoint)]
    assert run([*arguments, "--json", "--all"]) == 0
    rows = {row["name"]: row for row in json.loads(capsys.readouterr().out)}
    assert set(rows) == {"encode", "encode.0", "encode.1", "middle", "unused", "decode"}
    assert "never runs" in rows["unused"]["problem"]
    assert run([*arguments, "--all"]) == 0
    lines = capsys.readouterr().out.splitlines()
    shown = {words[0]: words[1:] for words in map(str.split, lines) if words}
    assert shown["unused"] == ["–", *rows["unused"]["problem"].split()]


def test_a_stdout_that_cannot_show_every_character_shows_the_others(frame: FrameOnDisk) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "pnpdepth_cli", "eval", frame.gt, frame.gt],
        env={**os.environ, "PYTHONIOENCODING": "ascii"}, capture_output=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr.decode()
    assert b"?1 ?  " in done.stdout


def test_several_models_are_the_first_and_more() -> None:
    arguments = ["a.png", "--sparse", "s.png", "--model", "fcrn-tiny", "--model", "eigen-tiny"]
    values = refine_command.make_context("refine", arguments).params
    del values["as_json"]
    network = request_of(values).network
    assert (network.model, network.more_models) == ("fcrn-tiny", ("eigen-tiny",))


def test_an_onnx_file_is_refined_and_checked(
    frame: FrameOnDisk, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("onnxruntime", reason="needs the extra [onnx]")
    from tests.models.onnx.onnx_files import write_network

    net = str(write_network(frame.folder / "net.onnx"))
    arguments = ["refine", str(frame.image), "--sparse", str(frame.sparse), "--model", net]
    output = ["-o", str(frame.folder / "o.exr"), "--iterations", "2", "--json"]
    assert run([*arguments, *output]) == 0
    record = json.loads(capsys.readouterr().out)
    assert record["settings"]["layer"] == "Relu_d"
    assert any("agrees with onnxruntime" in note for note in record["notes"])
    assert run(["models", "check", net, "--image", str(frame.image)]) == 0
    checked = json.loads(capsys.readouterr().out)
    assert set(checked["layers"].values()) == {"ok"}
    assert any("rgb range 'unit' is assumed" in note for note in checked["notes"])


def test_max_pixels_refuses_and_allows_an_image_by_its_size(frame: FrameOnDisk) -> None:
    arguments = ["sample", str(frame.gt), "--count", "5", "-o", str(frame.folder / "few.png")]
    assert run(["--max-pixels", "10", *arguments]) == 3
    assert run(arguments) == 0
