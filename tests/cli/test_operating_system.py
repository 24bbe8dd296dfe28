"""Errors of the operating system are one line and the right exit code, never a traceback."""

from __future__ import annotations

import errno
import json
import os
import struct
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

from pnpdepth_cli.cli import main as main_module
from pnpdepth_cli.cli.main import _exit_code, run
from pnpdepth_cli.io.depth import write_depth

SAMPLES = Path(__file__).parents[2] / "samples"
GT = SAMPLES / "indoor" / "gt.png"
POSIX = pytest.mark.skipif(os.name != "posix", reason="needs a POSIX shell")


def shell(line: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """The finished line of bash, in which `pnpdepth` is this tree's."""
    script = f'pnpdepth() {{ {sys.executable} -m pnpdepth_cli "$@"; }}\nset -o pipefail\n{line}\n'
    environment = os.environ | {"PYTHONPATH": str(SAMPLES.parent)}
    return subprocess.run(
        ["bash", "-c", script], cwd=folder, env=environment,
        capture_output=True, text=True, check=False,
    )  # fmt: skip


def sample_command(output: str) -> str:
    return f"pnpdepth sample {GT} --count 5 -o {output}"


@POSIX
def test_a_stdout_closed_before_the_start_disturbs_only_data_for_it(tmp_path: Path) -> None:
    done = shell(f"{sample_command('a.npy')} >&-", tmp_path)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "a.npy").read_bytes().startswith(b"\x93NUMPY")
    assert "Traceback" not in done.stderr
    done = shell(f"{sample_command('b.npy')} --json >&-", tmp_path)
    assert done.returncode == 2
    assert done.stderr == "pnpdepth: stdout cannot be written to: it is closed\n"
    assert shell("pnpdepth --version <&-", tmp_path).stdout.startswith("pnpdepth, version")


@POSIX
def test_a_reader_that_stops_early_is_no_error(tmp_path: Path) -> None:
    write_depth(tmp_path / "a.npy", np.full((8, 8), 2, np.float32))
    done = shell("pnpdepth eval a.npy a.npy 2>/dev/null | true", tmp_path)
    assert (done.returncode, done.stderr) == (0, "")


@POSIX
def test_what_openexr_prints_to_stdout_does_not_get_between_the_data(tmp_path: Path) -> None:
    for folder in ("pred", "gt"):
        (tmp_path / folder).mkdir()
        for name in "ab":
            write_depth(tmp_path / folder / f"{name}.exr", np.full((40, 30), 2.0, np.float32))
    damaged = tmp_path / "pred" / "b.exr"
    data = bytearray(damaged.read_bytes())
    # three blocks of 16 rows, whose offsets stand before the first of them
    table = next(p for p in range(len(data)) if struct.unpack_from("<Q", data, p)[0] == p + 24)
    (second,) = struct.unpack_from("<Q", data, table + 8)
    data[second : second + 4] = b"\xff\xff\xff\x7f"  # the number of its first row
    damaged.write_bytes(data)
    done = shell("pnpdepth eval pred gt --json", tmp_path)
    assert done.returncode == 7, done.stderr
    assert json.loads(done.stdout)["counts"]["scored"] == 1
    assert "Warning: Exception raised" not in done.stderr  # OpenEXR's own


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no device that is always full")
def test_a_full_stderr_does_not_stop_the_work_and_a_full_stdout_is_one_line(tmp_path: Path) -> None:
    for output, stderr in (("a.npy", "/dev/full"), ("b.npy", "/dev/null")):
        assert shell(f"{sample_command(output)} 2>{stderr}", tmp_path).returncode == 0
    assert (tmp_path / "a.npy").read_bytes() == (tmp_path / "b.npy").read_bytes()
    done = shell("pnpdepth --help >/dev/full", tmp_path)
    assert done.returncode == 2
    assert done.stderr == "pnpdepth: stdout cannot be written to: No space left on device\n"


@pytest.mark.parametrize(
    ("arguments", "code"),
    [
        (["sample", "{long}.png", "--count", "5", "-o", "a.png"], 3),
        (["sample", str(GT), "--count", "5", "-o", "{long}.png"], 2),
        (["refine", str(GT), "--sparse", "{long}"], 3),
        (["refine", str(GT), "--sparse", str(GT), "--model", "{long}.onnx", "-o", "a"], 4),
        (["batch", "{long}", "-o", "out"], 3),
        (["eval", "{long}", "{long}"], 3),
    ],
)
def test_names_of_5000_characters_are_one_line(
    arguments: list[str], code: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    long = "n" * 5000
    assert run([word.format(long=long) for word in arguments]) == code
    last = capsys.readouterr().err.splitlines()[-1]
    assert last.startswith("pnpdepth: ")
    assert len(last) < 2100


@pytest.mark.parametrize(
    ("path", "number", "code"),
    [
        ("in.png", errno.EACCES, 3),
        ("out/x_depth.png", errno.EACCES, 2),
        ("net.onnx", errno.EACCES, 4),
        ("weights/a/b", errno.EACCES, 4),
        ("table.csv", errno.ENAMETOOLONG, 2),
        ("in_refined", errno.EACCES, 2),
        (None, errno.ENOSPC, 2),
        (None, errno.EIO, 3),
    ],
)
def test_the_code_of_an_error_follows_from_the_option_of_its_file(
    path: str | None, number: int, code: int
) -> None:
    arguments = ["refine", "in.png", "--sparse", "s.png", "-o", "out", "--model", "net.onnx"]
    arguments += ["--checkpoint=weights", "--csv", "table.csv"]
    assert _exit_code(OSError(number, os.strerror(number), path), arguments) == code


@pytest.mark.parametrize(
    ("error", "code", "line"),
    [
        (MemoryError(), 6, "memory is exhausted"),
        (RuntimeError("DefaultCPUAllocator: can't allocate memory"), 6, "memory is exhausted"),
        (ImportError("failed to map segment from shared object"), 6, "memory is exhausted"),
        (PermissionError(errno.EACCES, "Permission denied", str(GT)), 3, "gt.png: Permission"),
        (KeyboardInterrupt(), 130, "interrupted"),
        (RuntimeError("a bug"), 1, None),
    ],
)
def test_an_error_of_the_system_is_one_line_and_a_bug_a_traceback(
    error: BaseException, code: int, line: str | None,
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    def failing(arguments: list[str]) -> int:
        raise error

    monkeypatch.setattr(main_module, "_run_command", failing)
    if line is None:  # a bug stays a traceback
        with pytest.raises(type(error)):
            run([])
        return
    assert run([]) == code
    err = capsys.readouterr().err
    assert err.startswith("pnpdepth: ")
    assert line in err
    assert err.count("\n") == 1


def python(code: str, environment: Mapping[str, str] = {}) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", code], env={**os.environ, **environment},
        capture_output=True, text=True, check=False,
    )  # fmt: skip


@pytest.mark.parametrize(
    "line", ["raise KeyboardInterrupt", "raise RuntimeError from KeyboardInterrupt()"]
)
def test_ctrl_c_during_the_first_imports_is_one_line(tmp_path: Path, line: str) -> None:
    (tmp_path / "click.py").write_text(line)
    path = os.pathsep.join([str(tmp_path), str(SAMPLES.parent)])
    done = python("from pnpdepth_cli.cli.start import main; main()", {"PYTHONPATH": path})
    assert (done.returncode, done.stderr) == (130, "pnpdepth: interrupted\n")


@POSIX
def test_ctrl_c_at_the_very_end_keeps_the_exit_code() -> None:
    done = python(
        "import atexit, os, signal, sys\n"
        "atexit.register(lambda: os.kill(os.getpid(), signal.SIGINT))\n"
        "sys.argv = ['pnpdepth', '--version']\n"
        "from pnpdepth_cli.cli.start import main\nmain()\n"
    )
    assert (done.returncode, done.stderr) == (0, "")


@POSIX
def test_little_memory_ends_with_code_6_or_works(tmp_path: Path) -> None:
    line = f"ulimit -v 300000; pnpdepth refine {SAMPLES}/indoor/rgb.png --sparse {GT} -o out"
    done = shell(line, tmp_path)
    assert done.returncode == 6, done.stderr
    assert "Traceback" not in done.stderr
