"""`batch --vary`: a folder for every combination of values of options."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from pnpdepth_cli.cli.main import run

NETWORK = ["--model", "drive/net/my_net.py", "--checkpoint", "drive/net/my_net.safetensors"]


def batch(*more: str) -> int:
    return run(["batch", "drive", "-o", "out", *NETWORK, *more])


def summaries() -> dict[str, dict[str, object]]:
    """What summary.json says, by the folder."""
    return {p.parent.name: json.loads(p.read_text()) for p in Path("out").glob("*/summary.json")}


def test_every_combination_is_the_batch_with_these_options(root: Path) -> None:
    assert batch("--vary", "lr=1%,3%", "--vary", "iterations=0,2", "--limit", "1") == 0
    assert set(summaries()) == {
        *("lr=1%,iterations=0", "lr=1%,iterations=2", "lr=3%,iterations=0", "lr=3%,iterations=2")
    }
    assert summaries()["lr=3%,iterations=2"]["varied"] == {"lr": "3%", "iterations": "2"}
    plain = ["batch", "drive", "-o", "plain", *NETWORK, "--lr", "3%", "--iterations", "2"]
    assert run([*plain, "--limit", "1"]) == 0
    depth = Path("plain/a_depth.png").read_bytes()
    assert Path("out/lr=3%,iterations=2/a_depth.png").read_bytes() == depth
    assert Path("out/lr=1%,iterations=2/a_depth.png").read_bytes() != depth


def test_the_default_method_the_number_of_points_networks_and_switches_can_be_varied(
    root: Path,
) -> None:
    assert batch("--vary", "method=fused,paper", "--vary", "sample=20,10%", "--limit", "1") == 0
    fixed = {name: each["fixed_by"] for name, each in summaries().items()}
    assert [fixed[f"method=fused,sample={n}"] for n in ("20", "10%")] == [""] * 2
    assert [fixed[f"method=paper,sample={n}"] for n in ("20", "10%")] == ["--method paper"] * 2
    command = ["batch", "drive", "-o", "out", "--limit", "1", "--iterations", "0"]
    varied = ["--vary", "model=eigen-tiny,fcrn-tiny", "--vary", "uncertainty=on,off"]
    assert run([*command, *varied]) == 0


def test_a_second_run_does_only_what_is_missing_and_failed_frames_stop_no_combination(
    root: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (root / "rgb/b.png").write_bytes(b"")
    assert batch("--propagate", "none", "--limit", "1", "--vary", "iterations=0") == 0
    capsys.readouterr()
    assert batch("--propagate", "none", "--vary", "iterations=0,1") == 7
    assert "(1 new)" in capsys.readouterr().err
    counts = [each["counts"] for each in summaries().values()]
    assert [(each["done"], each["failed"]) for each in counts] == [(1, 1)] * 2  # type: ignore[index]


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["colour=red"], "choose from sample, model"),
        (["lr=1%,,3%"], "empty"),
        (["lr=fast"], "lr must be"),
        (["lr=1%,1%"], "twice"),
        (["lr=1%,3%", "--lr", "1%"], "--lr is varied"),
    ],
)
def test_what_cannot_be_varied_is_wrong_usage(
    root: Path, capsys: pytest.CaptureFixture[str], more: list[str], message: str
) -> None:
    assert batch("--vary", *more) == 2
    assert message in capsys.readouterr().err.splitlines()[-1]
    assert not Path("out").exists()
