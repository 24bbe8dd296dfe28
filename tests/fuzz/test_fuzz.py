"""Damaged files of every kind end in one line and an exit code, in bounded time and memory.

PNPDEPTH_FUZZ_INPUTS and PNPDEPTH_FUZZ_SEED ask for more than the few hundred inputs of a test run.
"""

from __future__ import annotations

import faulthandler
import os
import re
import shutil
import sys
import tempfile
import warnings
from collections import Counter
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from safetensors.numpy import save_file
from torch import nn

pytestmark = pytest.mark.slow
for package in ("onnx", "onnxruntime", "resource", "rosbags"):
    pytest.importorskip(package)

# ruff: noqa: E402
from pnpdepth_cli.cli.main import main
from pnpdepth_cli.io.depth import write_depth
from tests.bags import write_bag
from tests.colmap_models import write_binary_model, write_text_model
from tests.data_sets import HEIGHT, WIDTH, image
from tests.io.calibration_files import FOUR, KALIBR, KITTI, POSES, ROS, opencv_file
from tests.io.scan_files import FILES
from tests.models.onnx.onnx_files import write_network
from tests.models.weights.files import little, written

INPUTS = int(os.environ.get("PNPDEPTH_FUZZ_INPUTS", "400"))
SEED = int(os.environ.get("PNPDEPTH_FUZZ_SEED", "0"))
INTEGERS = (0, 1, -1, 2**7, 2**15 - 1, 2**16, 2**31 - 1, -(2**31), 2**32 - 1, 2**62)
WORDS = ("", "nan", "inf", "-1", "0", "1e308", "9" * 30, "../..", "=1+1", "☃", "[" * 500, "null")
FORBIDDEN = ("os.system", "os.exec", "os.posix_spawn", "subprocess.Popen", "socket.connect")
CHANGES = {"os.rename": 2, "os.link": 2, "os.symlink": 2, "os.remove": 1, "os.mkdir": 1}
"""Audit events that change files, and how many paths each has."""
OUT = "-o out.png --overwrite"
LISTING = "-o batch --limit 1 --shard 2/2"
"""Of a batch that lists its frames and refines none."""
ANY_WEIGHTS = """
import torch
from torch import nn
from pnpdepth_cli.models.definition import ModelDefinition, Multiple

definition = ModelDefinition(
    name="any-weights", input_kind="rgb", size=Multiple(1),
    build=lambda: nn.Conv2d(3, 1, 1, bias=False),
    read_checkpoint=lambda stored: {"weight": torch.ones(1, 3, 1, 1)},
)
"""
"""A network that every checkpoint fits."""


def write_files() -> dict[str, str]:
    """Writes into the working folder; returns the arguments of `pnpdepth` by the file they read."""
    rng = np.random.default_rng(0)
    depth = rng.uniform(1, 9, (HEIGHT, WIDTH)).astype(np.float32)
    pixels = rng.integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    cv2.imwrite("rgb.png", pixels)
    cv2.imwrite("wide.png", np.zeros((480, 640, 3), np.uint8))  # of the calibrations
    commands = {}
    for suffix in ("png", "exr", "npy", "npz", "pfm", "tif"):
        write_depth(Path(f"depth.{suffix}"), depth)
        commands[f"depth.{suffix}"] = f"sample depth.{suffix} --count 20 {OUT}"
    for suffix in ("png", "jpg", "webp", "tif"):
        cv2.imwrite(f"image.{suffix}", pixels)
        features = f"sample depth.npy --count features:5 {OUT}"
        commands[f"image.{suffix}"] = f"{features} --image image.{suffix}"
    return commands | _scans(rng) | _cameras() | _networks(rng) | _data_sets(depth)


def _scans(rng: np.random.Generator) -> dict[str, str]:
    points = rng.uniform((5, -3, -2), (30, 3, 2), (200, 3)).astype(np.float32)
    Path("calib.txt").write_text("K: 30 0 16 0 30 12 0 0 1\nR: 0 -1 0 0 0 -1 1 0 0\nt: 0 0 0\n")
    commands = {}
    for name, content in FILES.items():
        Path(name).write_bytes(content(points))
        commands[name] = f"project {name} --calib calib.txt --image rgb.png {OUT}"
    for name in ("drive.bag", "drive.mcap"):
        commands[write_bag(Path(name), frames=2).name] = f"frames {name} -o frames"
    for path in write_bag(Path("ros2"), frames=2).iterdir():
        commands[path.as_posix()] = "frames ros2 -o frames"
    return commands


def _cameras() -> dict[str, str]:
    ros = ROS.format(model="equidistant", data=FOUR)
    calibrations = {"kitti.txt": KITTI, "ros.yaml": ros, "kalibr.yaml": KALIBR}
    calibrations["opencv.yml"] = opencv_file(FOUR)
    texts = calibrations | {f"pose{n}.yaml": text for n, text in enumerate(POSES.values())}
    commands = {}
    for name, text in texts.items():
        Path(name).write_text(text)
        calib, pose = (name, "pose0.yaml") if name in calibrations else ("ros.yaml", name)
        scan = f"project kitti.bin --image wide.png {OUT}"
        commands[name] = f"{scan} --calib {calib} --extrinsics {pose}"
    return commands


def _networks(rng: np.random.Generator) -> dict[str, str]:
    tensors = {"a.weight": rng.normal(size=(4, 3)).astype(np.float32), "a.bias": np.zeros(4)}
    state = {name: torch.from_numpy(value) for name, value in tensors.items()}
    save_file(tensors, "net.safetensors")
    torch.save({"state_dict": state, "epoch": 3}, "net.pt")
    torch.save(state, "old.pth", _use_new_zipfile_serialization=False)
    np.save("net.npy", np.array(tensors, dtype=object), allow_pickle=True)
    Path("any_weights.py").write_text(ANY_WEIGHTS)
    weights = ("net.safetensors", "net.pt", "old.pth", "net.npy", written(Path()).name)
    commands = {name: f"models check any_weights.py --checkpoint {name}" for name in weights}
    write_network(Path("net.onnx"), shape=(1, 3, HEIGHT, WIDTH))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        program = torch.export.export(nn.Conv2d(3, 1, 1), (torch.rand(1, 3, HEIGHT, WIDTH),))
        torch.export.save(program, "net.pt2")
    return commands | {name: f"models check {name}" for name in ("net.onnx", "net.pt2")}


def _data_sets(depth: np.ndarray) -> dict[str, str]:
    """What a batch reads before its first frame."""
    write_depth(Path("sparse.png"), depth)
    Path("frames.csv").write_text("image,sparse,gt,name\nrgb.png,sparse.png,depth.npy,a\n")
    write_text_model(Path("photos/sparse/0"))
    write_binary_model(Path("binary/sparse/0"))
    images = ("photos/images/a.png", "photos/images/b.png", "photos/images/c.png")
    images += ("binary/images/dir/1.png", "binary/images/dir/2.png")
    for name in images:
        image(Path(name))
    models = [path for root in ("photos", "binary") for path in Path(root, "sparse/0").iterdir()]
    return {
        "frames.csv": f"batch frames.csv {LISTING}",
        **{path.as_posix(): f"batch {path.parts[0]} {LISTING}" for path in models},
    }


def damaged(data: bytes, rng: np.random.Generator) -> bytes:
    """The bytes after one to four random damages, half of them where headers are."""
    result = bytearray(data)
    for _ in range(int(rng.integers(1, 5))):
        most = len(result) if rng.random() < 0.5 else min(len(result), 256)
        at = int(rng.integers(most + 1))
        length = int(rng.integers(1, 65))
        words = list(re.finditer(rb"[-+.\w]+", bytes(result[:20_000])))
        kind = int(rng.integers(6 if words else 5))
        if kind == 0:
            result[at:] = b""
        elif kind == 1:
            result[at : at + length] = b""
        elif kind == 2:
            result[at:at] = rng.bytes(length)
        elif kind == 3 and at < len(result):
            result[at] ^= 1 << int(rng.integers(8))
        elif kind == 4:
            width = int(rng.choice([1, 2, 4, 8]))
            value = INTEGERS[int(rng.integers(len(INTEGERS)))] % (1 << 8 * width)
            result[at : at + width] = value.to_bytes(width, "little")
        elif kind == 5:
            word = words[int(rng.integers(len(words)))]
            result[word.start() : word.end()] = WORDS[int(rng.integers(len(WORDS)))].encode()
    return bytes(result)


def problem(event: str, arguments: tuple[Any, ...], folder: Path) -> str | None:
    """What an input caused that none may: a process, a connection, a change outside the folder."""
    if event in FORBIDDEN:
        return event
    writes = event == "open" and arguments[2] & (os.O_WRONLY | os.O_RDWR | os.O_CREAT)
    for path in arguments[: CHANGES.get(event, int(bool(writes)))]:
        if isinstance(path, str | bytes | os.PathLike) and os.fsdecode(path) != os.devnull:
            real = Path(os.path.realpath(os.fsdecode(path)))
            if not real.is_relative_to(folder):
                return f"{event} {real}"
    return None


def exit_code(command: str) -> object:
    with pytest.raises(SystemExit) as end:
        main(command.split())
    for name in ("out.png", "out.png.json", "out.json", "batch", "frames"):
        shutil.rmtree(name) if Path(name).is_dir() else Path(name).unlink(missing_ok=True)
    return end.value.code


def test_no_damaged_file_causes_a_traceback_a_hang_or_much_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    commands = write_files()
    codes = Counter[object]()
    problems = list[str]()
    for file, command in commands.items():  # imports and caches are nobody's cost
        assert exit_code(command) in (0, 7), (file, capfd.readouterr())
    watching = [True]

    def watch(event: str, arguments: tuple[Any, ...]) -> None:
        if watching and (found := problem(event, arguments, tmp_path)):
            problems.append(found)

    sys.addaudithook(watch)
    for number in range(INPUTS):
        file, command = list(commands.items())[number % len(commands)]
        whole = Path(file).read_bytes()
        Path(file).write_bytes(damaged(whole, np.random.default_rng((SEED, number))))
        faulthandler.dump_traceback_later(240, exit=True)
        with little(megabytes=1500):
            code = exit_code(command)
        faulthandler.cancel_dump_traceback_later()
        Path(file).write_bytes(whole)
        err = capfd.readouterr().err
        where = f"input {number} of seed {SEED}: {file}"
        assert code in {0, 2, 3, 4, 5, 6, 7}, (where, err)
        assert "Traceback" not in err, (where, err)
        assert problems == [], where
        codes[code] += 1
    watching.clear()
    assert min(codes[0], codes[3]) > 0  # some inputs stay valid, most do not
