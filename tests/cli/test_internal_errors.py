"""A bug ends with code 1 and its traceback; no reader calls the user's file damaged."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from pnpdepth_cli.cli.main import run
from pnpdepth_cli.io.bags import open_bag
from pnpdepth_cli.io.depth import read_depth, write_depth
from pnpdepth_cli.models.network import load_network
from tests.bags import write_bag


def broken(*_: object, **__: object) -> None:
    """As after a library renamed what is used of it."""
    raise AttributeError("module 'library' has no attribute 'function'")


def onnx(path: Path) -> None:
    pytest.importorskip("onnxruntime")
    from tests.models.onnx.onnx_files import write_network

    write_network(path)


def depth(path: Path) -> None:
    write_depth(path, np.ones((4, 5), np.float32))


READERS: list[tuple[str, str, Callable[[Path], object], Callable[[Path], object]]] = [
    ("d.png", "PIL.Image.open", depth, read_depth),
    ("d.tif", "PIL.TiffImagePlugin.ImageFileDirectory_v2", depth, read_depth),
    ("d.exr", "OpenEXR.File", depth, read_depth),
    ("d.npy", "numpy.lib.format.read_magic", depth, read_depth),
    ("d.npz", "zipfile.ZipFile", depth, read_depth),
    ("d.mcap", "rosbags.rosbag2.Reader.open", write_bag, lambda path: open_bag(path).__enter__()),
    ("n.onnx", "onnx.load", onnx, lambda path: load_network(str(path), None)),
]


@pytest.mark.parametrize(
    ("name", "function", "make", "read"), READERS, ids=[name for name, *_ in READERS]
)
def test_a_library_without_a_function_is_no_damaged_file(
    name: str, function: str, make: Callable[[Path], object], read: Callable[[Path], object],
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    pytest.importorskip(function.partition(".")[0])
    make(tmp_path / name)
    monkeypatch.setattr(function, broken)
    with pytest.raises(AttributeError, match="no attribute 'function'"):
        read(tmp_path / name)


def test_a_bug_ends_with_code_1_and_its_traceback_on_stderr(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    depth(tmp_path / "d.png")
    monkeypatch.setattr("PIL.Image.open", broken)
    assert run(["sample", str(tmp_path / "d.png"), "--count", "3", "-o", "s.png"]) == 1
    err = capsys.readouterr().err
    assert "AttributeError" in err.splitlines()[-1]
    assert "in broken" in err


@pytest.mark.parametrize("record", [{"frames": [3]}, {"frames": [{"name": "a", "scores": 3}]}])
def test_a_summary_of_another_shape_is_a_file_of_another_format(
    record: object, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "a.json").write_text(json.dumps(record))
    assert run(["compare", str(tmp_path / "a.json"), str(tmp_path / "a.json")]) == 3
    assert "a.json" in capsys.readouterr().err
