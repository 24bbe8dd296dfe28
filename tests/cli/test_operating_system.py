"""Errors of the operating system are one line and the right exit code, never a traceback."""

from __future__ import annotations

import errno
import json
import os
import struct
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from pnpdepth_cli.cli.main import cli, run
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


@POSIX
def test_a_reader_that_stops_early_is_no_error(tmp_path: Path) -> None:
    write_depth(tmp_path / "a.npy", np.full((8, 8), 2, np.float32))
    for command in ("eval a.npy a.npy 2>/dev/null", "eval a.npy a.npy --json 2>&1", "--help"):
        done = shell(f"pnpdepth {command} | true", tmp_path)
        assert (done.returncode, done.stderr) == (0, "")


@POSIX
def test_what_openexr_prints_to_stdout_does_not_get_between_the_data(tmp_path: Path) -> None:
    for path in (tmp_path / "pred", tmp_path / "gt"):
        path.mkdir()
        for name in "ab":
            write_depth(path / f"{name}.exr", np.full((40, 30), 2.0, np.float32))
    data = bytearray((tmp_path / "pred/b.exr").read_bytes())
    # three blocks of 16 rows, whose offsets stand before the first of them
    table = next(p for p in range(len(data)) if struct.unpack_from("<Q", data, p)[0] == p + 24)
    (second,) = struct.unpack_from("<Q", data, table + 8)
    data[second : second + 4] = b"\xff\xff\xff\x7f"  # the number of its first row
    (tmp_path / "pred/b.exr").write_bytes(data)
    done = shell("pnpdepth eval pred gt --json", tmp_path)
    assert done.returncode == 7, done.stderr
    assert json.loads(done.stdout)["counts"]["scored"] == 1
    assert "Warning: Exception raised" not in done.stderr  # OpenEXR's own


@POSIX
def test_a_full_stdout_and_too_little_memory_are_one_line(tmp_path: Path) -> None:
    lines = {f"ulimit -v 300000; pnpdepth refine {GT} --sparse {GT} -o out": 6}
    if Path("/dev/full").exists():
        lines["pnpdepth --help >/dev/full"] = 2
    for line, code in lines.items():
        done = shell(line, tmp_path)
        assert (done.returncode, done.stderr.count("\n")) == (code, 1), done.stderr


@pytest.mark.parametrize(
    ("error", "code", "line"),
    [
        (MemoryError(), 6, "memory is exhausted"),
        (RuntimeError("DefaultCPUAllocator: can't allocate memory"), 6, "memory is exhausted"),
        (PermissionError(errno.EACCES, "Permission denied", str(GT)), 3, "gt.png: Permission"),
        (OSError(errno.ENOSPC, "No space left on device"), 2, "No space"),
        (KeyboardInterrupt(), 130, "interrupted"),
    ],
)
def test_an_error_of_the_system_is_one_line(
    error: BaseException, code: int, line: str,
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    def failing(context: object) -> None:
        raise error

    monkeypatch.setattr(cli, "invoke", failing)
    assert run(["doctor"]) == code
    err = capsys.readouterr().err.strip()
    assert line in err
    assert "\n" not in err
