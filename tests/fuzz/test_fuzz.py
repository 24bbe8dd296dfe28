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
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytestmark = pytest.mark.slow
for package in ("onnx", "onnxruntime", "resource", "rosbags"):
    pytest.importorskip(package)

from pnpdepth_cli.cli.main import main  # noqa: E402
from tests.fuzz.valid_files import write_files  # noqa: E402
from tests.models.weights.files import little  # noqa: E402

INPUTS = int(os.environ.get("PNPDEPTH_FUZZ_INPUTS", "400"))
SEED = int(os.environ.get("PNPDEPTH_FUZZ_SEED", "0"))
HANGS_S = 240
INTEGERS = (0, 1, -1, 2**7, 2**15 - 1, 2**16, 2**31 - 1, -(2**31), 2**32 - 1, 2**62)
WORDS = ("", "nan", "inf", "-1", "0", "1e308", "9" * 30, "../..", "=1+1", "☃", "[" * 500, "null")
FORBIDDEN = ("os.system", "os.exec", "os.posix_spawn", "subprocess.Popen", "socket.connect")
CHANGES = {"os.rename": 2, "os.link": 2, "os.symlink": 2, "os.remove": 1, "os.mkdir": 1}
"""Audit events that change files, and how many paths each has."""


def damaged(data: bytes, rng: np.random.Generator) -> bytes:
    """The bytes after one to four random damages, half of them where headers are."""
    result = bytearray(data)
    for _ in range(int(rng.integers(1, 5))):
        most = len(result) if rng.random() < 0.5 else min(len(result), 256)
        at, length = int(rng.integers(most + 1)), int(rng.integers(1, 65))
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
    commands, codes, problems = write_files(), Counter[object](), list[str]()
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
        faulthandler.dump_traceback_later(HANGS_S, exit=True)
        with little(megabytes=1500):
            code = exit_code(command)
        faulthandler.cancel_dump_traceback_later()
        Path(file).write_bytes(whole)
        err, where = capfd.readouterr().err, f"input {number} of seed {SEED}: {file}"
        assert code in {0, 2, 3, 4, 5, 6, 7}, (where, err)
        assert "Traceback" not in err, (where, err)
        assert problems == [], where
        codes[code] += 1
    watching.clear()
    assert min(codes[0], codes[3]) > 0  # some inputs stay valid, most do not
