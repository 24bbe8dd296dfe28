from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from pnpdepth_cli.cli import refine_commands as command
from pnpdepth_cli.cli import terminal
from pnpdepth_cli.cli.main import run
from pnpdepth_cli.cli.terminal import BatchProgress, progress_bar
from pnpdepth_cli.dataset.frame_record import FrameRecord
from tests.commands.batches import add_frame

FAILED = FrameRecord(name="x", status="failed", message="bad")


def arguments(*more: str) -> list[str]:
    network = ["--model", "drive/net/my_net.py", "--checkpoint", "drive/net/my_net.safetensors"]
    return ["batch", "drive", "-o", "out", *network, "--propagate", "none", *more]


def test_a_bad_frame_is_one_line_and_exit_code_7_whatever_its_name(
    root: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (root / "rgb/b.png").write_bytes(b"")
    for part in ("rgb", "sparse"):
        (root / part / "b.png").rename(root / part / "b\nb\x1b.png")
    assert run(arguments()) == 7
    err = capsys.readouterr().err
    (line,) = [line for line in err.splitlines() if line.startswith("failed")]
    assert line.startswith("failed: b\\nb\\x1b: drive/rgb/b\\nb\\x1b.png is empty")
    assert "out/summary.csv" in err.splitlines()[-1]
    assert "\x1b" not in err


def test_ray_without_an_address_is_this_machine_and_is_imported_only_to_run(
    root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    assert [run(arguments(*more)) for more in ((), ("--ray",))] == [0, 0]
    assert run(arguments("--ray", "--seed", "1")) == 2


def test_a_run_with_nothing_to_do_needs_no_torch(root: Path) -> None:
    assert run(arguments()) == 0
    code = (
        "import sys\nfrom pnpdepth_cli.cli.main import run\n"
        "sys.exit(run(sys.argv[1:]) or 'torch' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code, *arguments()], check=False).returncode == 0


@pytest.mark.slow
def test_ctrl_c_finishes_the_frame_prints_how_to_continue_and_exits_130(root: Path) -> None:
    for name in "cd":
        add_frame(root, name)
    slow = root / "net/my_net.py"
    text = slow.read_text().replace("        return 2", "        time.sleep(0.1)\n        return 2")
    slow.write_text("import time\n" + text)
    program = [sys.executable, "-m", "pnpdepth_cli", *arguments()]
    with subprocess.Popen(program, stderr=subprocess.PIPE, text=True) as running:
        until = time.monotonic() + 60
        while not list(Path("out").glob("*.json")):
            assert time.monotonic() < until
            time.sleep(0.01)
        running.send_signal(signal.SIGINT)
        _, err = running.communicate(timeout=60)
    assert running.returncode == 130
    assert "of 4 frames; run the same command to continue" in err.splitlines()[-1]
    assert "Traceback" not in err
    depths = {path.name[0] for path in Path("out").glob("*_depth.png")}
    assert depths == {path.stem for path in Path("out").glob("?.json")}
    assert not [p for p in Path("out").iterdir() if p.name[0] == "." and p.suffix != ".lock"]
    assert run(arguments()) == 0


def test_the_second_ctrl_c_interrupts_and_the_old_handling_comes_back() -> None:
    before = signal.getsignal(signal.SIGINT)
    with command._finishing_on_interrupt() as stopped:
        assert not stopped()
        os.kill(os.getpid(), signal.SIGINT)
        assert stopped()
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) == before


def test_without_a_terminal_there_is_a_line_a_minute(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    now = 0.0
    monkeypatch.setattr(terminal.time, "monotonic", lambda: now)
    with progress_bar("batch", "frame") as show:
        display = BatchProgress(show, lambda: False)
        display.begin(600)
        for number in range(300):
            now += 1.0
            display.frame(FAILED if number == 10 else FrameRecord(name="y"))
    failed, first, *others = capsys.readouterr().err.splitlines()
    assert failed == "failed: x: bad"
    assert "60/600 [01:00<09:00" in first
    assert len(others) == 4


def test_on_a_terminal_there_is_a_bar(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    monkeypatch.setattr(terminal, "_SHOWN_AFTER_S", 0)
    with progress_bar("batch", "frame") as show:
        display = BatchProgress(show, lambda: False)
        display.begin(2)
        display.frame(FAILED)
        display.frame(FrameRecord(name="y"))
    err = capsys.readouterr().err
    assert "failed: x: bad\n" in err
    assert " 0/2" in err
