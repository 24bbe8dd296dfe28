from __future__ import annotations

import pytest

from pnpdepth_cli.cli import bench as bench_command
from pnpdepth_cli.cli.main import run
from tests.commands.frames import FrameOnDisk


def bench(frame: FrameOnDisk, *more: str) -> list[str]:
    return [
        "bench", "--model", str(frame.model), "--checkpoint", str(frame.checkpoint),
        "--size", "24x32", "--points", "50", "--repeats", "1", *more,
    ]  # fmt: skip


def test_the_table_goes_to_stdout_and_what_it_was_measured_with_to_stderr(
    frame: FrameOnDisk, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(bench(frame, "--layer", "encode", "--iterations", "2")) == 0
    out, err = capsys.readouterr()
    assert "cut at encode, 32×24, 50 points, K = 2, fp32" in " ".join(out.split())
    for part in ("forward", "rear and gradient", "refinement"):
        assert part in out
    assert "the limit is" in out
    assert "torch" in err


def test_times_are_in_milliseconds_and_forward_passes(capsys: pytest.CaptureFixture[str]) -> None:
    part = {"median_s": 1.25, "lower_s": 1.0, "upper_s": 1.5, "forwards": 2.0, "peak_mb": 1234.5}
    bench_command._print(
        {
            "device": "cpu",
            "threads": 1,
            "versions": {"torch": "2"},
            "notes": [],
            "size": (24, 32),
            "points": 50,
            "model": "net",
            "layer": "z",
            "iterations": 5,
            "parts": {"refinement": part, "other": part | {"peak_mb": None}},
            "limit": 1.5,
            "precision": "fp32",
        }
    )
    out, err = capsys.readouterr()
    *_, first, second, _, last = (" ".join(line.split()) for line in out.splitlines())
    assert err == "cpu, 1 thread, torch 2\n"
    assert first == "refinement 1,250.0 ms 1,000.0–1,500.0 ms 2.00 1,234 MB"
    assert second == "other 1,250.0 ms 1,000.0–1,500.0 ms 2.00"
    assert last == "a refinement takes 2.00 forward passes; the limit is 1.50"
