"""`pnpdepth batch`: failures, Ctrl-C, progress, and `--vary`."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from pnpdepth_cli.cli.batch import _finishing_on_interrupt
from pnpdepth_cli.cli.main import run
from pnpdepth_cli.cli.terminal import progress_bar, say_above_bar
from pnpdepth_cli.commands.requests.batch_request import Listener
from pnpdepth_cli.dataset.frame_record import FrameRecord
from tests.command_line import printed, working_in
from tests.commands.batches import add_frame, pairs_on_disk

NETWORK = ["--model", "drive/net/my_net.py", "--checkpoint", "drive/net/my_net.safetensors"]


def arguments(*more: str) -> list[str]:
    return ["batch", "drive", "-o", "out", *NETWORK, "--method", "paper", *more]


def summaries() -> dict[str, dict[str, Any]]:
    """What summary.json says, by the folder."""
    return {p.parent.name: json.loads(p.read_text()) for p in Path("out").glob("*/summary.json")}


def test_a_bad_frame_is_one_line_and_code_7(root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (root / "rgb/b.png").write_bytes(b"")
    for folder in ("rgb", "sparse"):
        (root / folder / "b.png").rename(root / folder / "b\nb\x1b.png")
    assert run(arguments()) == 7
    err = capsys.readouterr().err
    assert "\nfailed: b\\nb\\x1b: drive/rgb/b\\nb\\x1b.png is empty" in err
    assert "out/summary.csv" in err.splitlines()[-1]
    assert "\x1b" not in err


def test_the_exit_code_is_of_the_frames_of_this_run(root: Path) -> None:
    (root / "rgb/b.png").write_bytes(b"")
    assert run(arguments()) == 7
    assert run(arguments("--frames", "a")) == 0
    assert run(arguments("--frames", "b*")) == 7


def test_nothing_to_do_needs_no_ray_or_torch(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    assert run(arguments()) == 0
    assert run(arguments("--ray")) == 0
    assert run(arguments("--ray", "--seed", "1")) == 2
    code = (
        "import sys\nfrom pnpdepth_cli.cli.main import run\n"
        "sys.exit(run(sys.argv[1:]) or 'torch' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code, *arguments()], check=False).returncode == 0


class Interrupted(NamedTuple):
    """A batch in its folder, with its exit code and what it printed to stderr."""

    folder: Path
    code: int
    err: str


@pytest.fixture(scope="module")
def interrupted(tmp_path_factory: pytest.TempPathFactory) -> Interrupted:
    """A batch of four slow frames, which got Ctrl-C after its first record."""
    folder = tmp_path_factory.mktemp("interrupted")
    root = pairs_on_disk(folder / "drive", ("a", "b"))
    for name in ("c", "d"):
        add_frame(root, name)
    slow = root / "net/my_net.py"
    text = slow.read_text().replace("        return 2", "        time.sleep(0.1)\n        return 2")
    slow.write_text("import time\n" + text)
    program = [sys.executable, "-m", "pnpdepth_cli", *arguments()]
    with subprocess.Popen(program, cwd=folder, stderr=subprocess.PIPE, text=True) as running:
        until = time.monotonic() + 60
        while not list(folder.glob("out/*.json")):
            assert time.monotonic() < until
            time.sleep(0.01)
        running.send_signal(signal.SIGINT)
        _, err = running.communicate(timeout=60)
    return Interrupted(folder=folder, code=running.returncode, err=err)


@pytest.mark.slow
def test_ctrl_c_exits_with_130_and_one_line_of_how_to_continue(interrupted: Interrupted) -> None:
    assert interrupted.code == 130
    assert "run the same command to continue" in interrupted.err.splitlines()[-1]
    assert "Traceback" not in interrupted.err


@pytest.mark.slow
def test_ctrl_c_finishes_the_frame_and_leaves_no_other_files(interrupted: Interrupted) -> None:
    out = interrupted.folder / "out"
    depths = {path.name[0] for path in out.glob("*_depth.png")}
    assert depths == {path.stem for path in out.glob("?.json")}
    hidden = [path for path in out.iterdir() if path.name.startswith(".")]
    assert [path.suffix for path in hidden if path.suffix != ".lock"] == []


@pytest.mark.slow
def test_the_same_command_after_ctrl_c_does_the_rest(interrupted: Interrupted) -> None:
    with working_in(interrupted.folder):
        assert run(arguments()) == 0
        assert len(list(Path("out").glob("*_depth.png"))) == 4


def test_the_second_ctrl_c_interrupts_and_the_old_handling_comes_back() -> None:
    before = signal.getsignal(signal.SIGINT)
    with _finishing_on_interrupt() as stopped:
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
    monkeypatch.setattr("time.monotonic", lambda: now)
    with progress_bar("batch", "frame") as show:
        listener = Listener(say_above_bar, show, lambda: False)
        listener.begin(600)
        for number in range(300):
            now += 1.0
            status = "failed" if number == 10 else "done"
            listener.frame(FrameRecord(name="x", status=status, message="bad"))
    failed, first, *others = capsys.readouterr().err.splitlines()
    assert failed == "failed: x: bad"
    assert "60/600 [01:00<09:00" in first
    assert len(others) == 4


class Varied(NamedTuple):
    """The folder of a study, and what was printed to stderr."""

    folder: Path
    err: str


@pytest.fixture(scope="module")
def varied(tmp_path_factory: pytest.TempPathFactory) -> Varied:
    """A batch of one frame with two step sizes, without updates and with two."""
    folder = tmp_path_factory.mktemp("varied")
    pairs_on_disk(folder / "drive", ("a", "b"))
    options = ["--vary", "lr=1%,3%", "--vary", "iterations=0,2", "--limit", "1"]
    with working_in(folder):
        done = printed(*arguments(*options))
    assert done.code == 0
    return Varied(folder=folder, err=done.err)


def test_every_combination_has_a_folder_but_those_that_only_differ_without_effect(
    varied: Varied,
) -> None:
    with working_in(varied.folder):
        # Without updates the step has no effect: one run.
        assert {*summaries()} == {"iterations=0", "lr=1%,iterations=2", "lr=3%,iterations=2"}
        assert summaries()["lr=3%,iterations=2"]["varied"] == {"lr": "3%", "iterations": "2"}


def test_what_is_said_of_the_data_is_said_once_for_all_combinations(varied: Varied) -> None:
    assert varied.err.count("layout: ") == 1


def test_every_combination_is_the_batch_with_these_options(varied: Varied) -> None:
    with working_in(varied.folder):
        plain = arguments("--lr", "3%", "--iterations", "2", "--limit", "1", "-o", "plain")
        assert run(plain) == 0
        depth = Path("plain/a_depth.png").read_bytes()
        assert Path("out/lr=3%,iterations=2/a_depth.png").read_bytes() == depth
        assert Path("out/lr=1%,iterations=2/a_depth.png").read_bytes() != depth


def test_method_number_of_points_networks_and_switches_can_be_varied(root: Path) -> None:
    batch = ["batch", "drive", "-o", "out", "--limit", "1"]
    assert run([*batch, *NETWORK, "--vary", "method=fused,paper", "--vary", "sample=20,10%"]) == 0
    methods = {name: summary["method"] for name, summary in summaries().items()}
    assert methods == {
        f"method={method},sample={count}": method
        for method in ("fused", "paper")
        for count in ("20", "10%")
    }
    varied = ["--vary", "model=eigen-tiny,fcrn-tiny", "--vary", "uncertainty=on,off"]
    assert run([*batch, "--iterations", "0", *varied]) == 0


def test_a_second_run_does_what_is_left(root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (root / "rgb/b.png").write_bytes(b"")
    assert run(arguments("--limit", "1", "--vary", "iterations=0")) == 0
    capsys.readouterr()
    assert run(arguments("--vary", "iterations=0,1")) == 7
    assert "(1 new)" in capsys.readouterr().err
    assert len(summaries()) == 2
    for summary in summaries().values():
        assert (summary["counts"]["done"], summary["counts"]["failed"]) == (1, 1)
