"""Every error is a line on stderr and the exit code of its kind; a bug is its traceback and 1."""

from __future__ import annotations

import errno
import json
import os
import subprocess
import sys
import warnings
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple
from unittest.mock import Mock

import numpy as np
import pytest
import torch

from pnpdepth_cli.cli.main import cli, main, run
from pnpdepth_cli.io.bags import open_bag
from pnpdepth_cli.io.depth import read_depth, write_depth
from pnpdepth_cli.models.network import load_network
from pnpdepth_cli.models.weights import read_checkpoint
from tests.bags import write_bag
from tests.command_line import Printed, printed, working_in
from tests.commands.batches import pairs_on_disk

SAMPLES = Path(__file__).parents[2] / "samples"
GT = SAMPLES / "indoor" / "gt.png"
RGB = SAMPLES / "indoor" / "rgb.png"
SPARSE = SAMPLES / "indoor" / "sparse.png"
SMALL = ["--model", "fcrn-tiny", "--method", "paper", "--iterations", "0"]
NETWORK = "--model drive/net/my_net.py --checkpoint drive/net/my_net.safetensors"
COMMANDS = {
    "refine": f"drive/rgb/a.png --sparse drive/sparse/a.png -o out {NETWORK}",
    "batch": f"drive -o out {NETWORK}",
    "sample": "drive/gt/a.png -o sparse.png",
    "eval": "drive/gt drive/gt",
}


class Mistake(NamedTuple):
    """A command with more options, the code of its kind of error and the thing that is named."""

    command: str
    options: str
    code: int
    named: str

    @property
    def line(self) -> str:
        return f"{self.command} {COMMANDS.get(self.command.split()[-1], '')} {self.options}"


MISTAKES = [
    Mistake("refine", f"--layer {'n' * 5000}", 4, "layers --all"),
    Mistake("refine", f"--model {'n' * 5000}.onnx", 3, "nnn.onnx"),
    Mistake("refine", "--checkpoint missing.pt", 4, "missing.pt"),
    Mistake("refine", "--device cuda:9", 6, "device cpu"),
    Mistake("refine", "--method paper --model compact", 2, "'paper'"),
    Mistake("batch", "--shard 0/2", 2, "1/4"),
    Mistake("batch", "--poses one_pose.txt", 3, "one_pose.txt"),
    Mistake("batch", "--adapt --shard 1/2", 2, "--adapt"),
    Mistake("batch", "--vary colour=red", 2, "--vary colour"),
    Mistake("batch", "--vary lr=1%,,3%", 2, "--vary"),
    Mistake("batch", "--vary lr=fast", 2, "'fast'"),
    Mistake("batch", "--vary lr=1%,1%", 2, "--vary"),
    Mistake("batch", "--vary lr=1%,3% --lr 1%", 2, "--lr"),
    Mistake("--max-pixels 10 sample", "--count 5", 3, "--max-pixels"),
    Mistake("sample", "--count many", 2, "'many'"),
    Mistake("eval", "--protocol kiti", 2, "kitti"),
    Mistake("eval", "--columns rmse,none", 2, "--columns none"),
    Mistake("compare a.json b.json", "--csv x --latex ./x", 2, "--csv and --latex"),
    Mistake("eval", "--json --csv -", 2, "--csv -"),
    Mistake("eval", "--protocol nyu-eigen", 3, "640×480"),
    Mistake("batch images.csv", "-o out", 2, "images.csv"),
    Mistake("compare missing.json", "missing.json", 3, "missing.json"),
]


class Failed(NamedTuple):
    """A mistake, what was printed, and the files before and after it."""

    mistake: Mistake
    printed: Printed
    before: list[Path]
    after: list[Path]


@pytest.fixture(scope="module", params=MISTAKES, ids=lambda m: f"{m.command} {m.options[:30]}")
def failed(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Failed:
    folder = tmp_path_factory.mktemp("failed")
    pairs_on_disk(folder / "drive", ("a", "b"))
    (folder / "images.csv").write_text("image\ndrive/rgb/a.png\n")
    (folder / "one_pose.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n")
    before = sorted(folder.rglob("*"))
    with working_in(folder):
        told = printed(*request.param.line.split())
    return Failed(request.param, told, before, sorted(folder.rglob("*")))


def test_the_exit_code_is_that_of_the_kind_of_error(failed: Failed) -> None:
    assert failed.printed.code == failed.mistake.code


def test_an_error_is_one_line_on_stderr_that_names_the_thing(failed: Failed) -> None:
    last = failed.printed.err.splitlines()[-1]
    assert failed.mistake.named in last
    assert len(last) < 2100
    assert failed.printed.out == ""
    assert "Traceback" not in failed.printed.err


def test_an_error_writes_no_file(failed: Failed) -> None:
    new = {path.name for path in failed.after if path not in failed.before}
    # A network is loaded in the folder of its results, which stays.
    assert new == {"out"} if failed.mistake.code in (4, 6) and new else new == set()


@pytest.mark.parametrize("value", [1e-45, 1e38, 3e38])
def test_numpy_says_nothing_of_numbers_that_it_cannot_divide(
    value: float, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    depth = read_depth(GT).values
    depth[::3] = value
    np.save(tmp_path / "d.npy", depth)
    (tmp_path / "k.txt").write_text("K: 260 0 160 0 260 120 0 0 1\n")
    arguments = [str(tmp_path / "d.npy"), "--calib", str(tmp_path / "k.txt")]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        run(["cloud", *arguments, "-o", str(tmp_path / "c.ply")])
        run(["eval", str(tmp_path / "d.npy"), str(GT)])
    assert "Warning" not in "".join(capfd.readouterr())


@pytest.mark.skipif(os.name != "posix", reason="needs a POSIX shell")
@pytest.mark.parametrize(
    ("line", "code", "errors"),
    [
        ("pnpdepth eval a.npy a.npy 2>/dev/null | true", 0, 0),
        ("pnpdepth eval a.npy a.npy --json 2>&1 | true", 0, 0),
        ("pnpdepth --help | true", 0, 0),
        ("PYTHONIOENCODING=ascii pnpdepth eval a.npy a.npy 2>/dev/null | grep -F '?1 ?  '", 0, 0),
        (f"ulimit -v 300000; pnpdepth refine {GT} --sparse {GT} -o out", 6, 1),
        ("test -e /dev/full || exit 2; pnpdepth --help >/dev/full", 2, 1),
    ],
)
def test_a_shell_causes_one_line_at_most(line: str, code: int, errors: int, tmp_path: Path) -> None:
    depth(tmp_path / "a.npy")
    script = f'pnpdepth() {{ {sys.executable} -m pnpdepth_cli "$@"; }}\nset -o pipefail\n{line}\n'
    done = subprocess.run(
        ["bash", "-c", script], cwd=tmp_path, env=os.environ | {"PYTHONPATH": str(SAMPLES.parent)},
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert (done.returncode, done.stderr.count("\n")) == (code, errors), done.stderr


def test_openexr_prints_none_to_stdout(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    folders = tmp_path / "pred", tmp_path / "gt"
    for folder in folders:
        folder.mkdir()
        for name in ("a.exr", "b.exr"):
            write_depth(folder / name, np.full((40, 30), 2.0, np.float32))
    cut = folders[0] / "b.exr"
    cut.write_bytes(cut.read_bytes()[:-8])
    assert run(["eval", *map(str, folders), "--json"]) == 7
    out, err = capfd.readouterr()
    assert json.loads(out)["counts"]["scored"] == 1
    assert "Warning: Exception raised" not in err  # OpenEXR's own


@pytest.mark.parametrize(
    ("error", "code", "line"),
    [
        (MemoryError(), 6, "memory is exhausted"),
        (PermissionError(errno.EACCES, "Permission denied", str(GT)), 3, "gt.png: Permission"),
        (OSError(errno.ENOSPC, "No space left on device"), 2, "No space"),
        (KeyboardInterrupt(), 130, "interrupted"),
        (AttributeError("no such function"), 1, "AttributeError: no such function"),
    ],
)
def test_an_error_of_the_system_is_one_line_and_a_bug_its_traceback(
    error: BaseException, code: int, line: str,
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.setattr(cli, "invoke", Mock(side_effect=error))
    assert run(["doctor"]) == code
    *traceback, last = capsys.readouterr().err.strip().splitlines()
    assert line in last
    assert traceback[:1] == (["Traceback (most recent call last):"] if code == 1 else [])


def onnx(path: Path) -> None:
    pytest.importorskip("onnxruntime")
    from tests.models.onnx.onnx_files import write_network

    write_network(path)


def depth(path: Path) -> None:
    write_depth(path, np.ones((4, 5), np.float32))


@pytest.mark.parametrize(
    ("name", "function", "make", "read"),
    [
        ("d.png", "PIL.Image.open", depth, read_depth),
        ("d.tif", "PIL.TiffImagePlugin.ImageFileDirectory_v2", depth, read_depth),
        ("d.exr", "OpenEXR.File", depth, read_depth),
        ("d.npy", "numpy.lib.format.read_magic", depth, read_depth),
        ("d.npz", "zipfile.ZipFile", depth, read_depth),
        ("d.mcap", "rosbags.rosbag2.Reader.open", write_bag, lambda p: open_bag(p).__enter__()),
        ("n.onnx", "onnx.load", onnx, lambda path: load_network(str(path), None)),
        ("w.pt", "zipfile.ZipFile", partial(torch.save, {"w": torch.ones(2)}), read_checkpoint),
    ],
)
def test_a_library_that_renamed_what_is_used_of_it_is_no_damaged_file(
    name: str, function: str, make: Callable[[Path], object], read: Callable[[Path], object],
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    pytest.importorskip(function.partition(".")[0])
    make(tmp_path / name)
    monkeypatch.setattr(function, Mock(side_effect=AttributeError("no such function")))
    with pytest.raises(AttributeError, match="no such function"):
        read(tmp_path / name)


@pytest.mark.skipif(os.name != "posix", reason="Windows needs a right to make links")
@pytest.mark.parametrize(
    ("arguments", "code"),
    [
        (["refine", "LOOP", "--sparse", str(GT), "-o", "out"], 3),
        (["refine", str(GT), "--sparse", "LOOP", "-o", "out"], 3),
        (["refine", str(GT), "--sparse", str(GT), "--depth", "LOOP", "-o", "out"], 3),
        (["refine", str(GT), "--sparse", str(GT), "--calib", "LOOP", "-o", "out"], 3),
        (["refine", str(GT), "--sparse", str(GT), "--model", "LOOP", "-o", "out"], 4),
        (["refine", str(RGB), "--sparse", str(SPARSE), *SMALL, "-o", "LOOP/out"], 2),
        (["batch", "LOOP", "-o", "out"], 3),
        (["frames", "LOOP", "-o", "out"], 3),
        (["eval", "LOOP", str(GT)], 3),
        (["compare", "LOOP", "LOOP"], 3),
        (["cloud", "LOOP", "-o", "out.ply"], 3),
        (["export", "LOOP", "--to", "colmap", "-o", "out"], 3),
    ],
)
def test_a_link_to_itself_is_no_file(
    arguments: list[str], code: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("loop.png").symlink_to("loop.png")
    assert run([argument.replace("LOOP", "loop.png") for argument in arguments]) == code
    assert [path.name for path in tmp_path.iterdir()] == ["loop.png"]


@pytest.mark.parametrize(("stated", "used"), [(None, "passive"), ("active", "active")])
def test_idle_threads_sleep_unless_the_user_says_otherwise(
    stated: str | None, used: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("OMP_WAIT_POLICY", "")
    monkeypatch.delenv("OMP_WAIT_POLICY")
    if stated is not None:
        monkeypatch.setenv("OMP_WAIT_POLICY", stated)
    with pytest.raises(SystemExit) as ended:
        main(["--version"])
    assert ended.value.code == 0
    assert os.environ["OMP_WAIT_POLICY"] == used
