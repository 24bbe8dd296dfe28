"""`batch --vary`: a folder for every combination of values of options."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from pnpdepth_cli.cli.main import run

NETWORK = ["--model", "drive/net/my_net.py", "--checkpoint", "drive/net/my_net.safetensors"]


def batch(*more: str) -> int:
    return run(["batch", "drive", "-o", "out", *NETWORK, *more])


def folders() -> list[str]:
    return sorted(path.name for path in Path("out").iterdir())


def summary(folder: str) -> dict[str, object]:
    record: dict[str, object] = json.loads(Path("out", folder, "summary.json").read_text())
    return record


def test_every_combination_is_the_batch_with_these_options(root: Path) -> None:
    assert batch("--vary", "lr=1%,3%", "--vary", "iterations=0,2", "--limit", "1") == 0
    assert folders() == [
        *("lr=1%,iterations=0", "lr=1%,iterations=2", "lr=3%,iterations=0", "lr=3%,iterations=2")
    ]
    varied = summary("lr=3%,iterations=2")
    assert varied["varied"] == {"lr": "3%", "iterations": "2"}
    plain = ["batch", "drive", "-o", "plain", *NETWORK, "--lr", "3%", "--iterations", "2"]
    assert run([*plain, "--limit", "1"]) == 0
    depth = Path("plain/a_depth.png").read_bytes()
    assert Path("out/lr=3%,iterations=2/a_depth.png").read_bytes() == depth
    assert Path("out/lr=1%,iterations=2/a_depth.png").read_bytes() != depth


def test_the_default_method_and_the_number_of_points_can_be_varied(root: Path) -> None:
    assert batch("--vary", "method=fused,paper", "--vary", "sample=20,10%", "--limit", "1") == 0
    fixed_by = {name: summary(name)["fixed_by"] for name in folders()}
    assert [fixed_by[f"method=fused,sample={n}"] for n in ("20", "10%")] == [""] * 2
    assert [fixed_by[f"method=paper,sample={n}"] for n in ("20", "10%")] == ["--method paper"] * 2


def test_a_second_run_does_only_what_is_missing(
    root: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["--limit", "1", "--propagate", "none", "--vary"]
    assert batch(*arguments, "iterations=0") == 0
    capsys.readouterr()
    assert batch(*arguments, "iterations=0,1") == 0
    err = capsys.readouterr().err
    assert err.index("all of them done already") < err.index("1 to do (1 new)")
    assert [summary(name)["varied"] for name in folders()] == [
        {"iterations": "0"},
        {"iterations": "1"},
    ]


def test_switches_and_networks_are_varied_too(root: Path) -> None:
    own = "model=eigen-tiny,fcrn-tiny"
    command = ["batch", "drive", "-o", "out", "--limit", "1", "--iterations", "0", "--vary"]
    assert run([*command, own]) == 0
    assert run([*command, "uncertainty=on,off"]) == 0


def test_failed_frames_of_a_combination_do_not_stop_the_others(
    root: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (root / "rgb/b.png").write_bytes(b"")
    assert batch("--propagate", "none", "--limit", "2", "--vary", "iterations=0,1") == 7
    assert [summary(name)["counts"]["failed"] for name in folders()] == [1, 1]
    assert "2 failed of" in capsys.readouterr().err.splitlines()[-1]


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["colour=red"], "choose from sample, model"),
        (["output=a,b"], "choose from"),
        (["lr=1%,,3%"], "empty"),
        (["lr"], "empty"),
        (["lr=fast"], "lr must be"),
        (["iterations=1.5"], "--iterations"),
        (["update=sgd,newton"], "--update"),
        (["lr=1%,1%"], "twice"),
        (["lr=1%", "--vary", "lr=3%"], "twice"),
        (["lr=1%,3%", "--lr", "1%"], "--lr is varied"),
    ],
)
def test_what_cannot_be_varied_is_wrong_usage(
    root: Path, capsys: pytest.CaptureFixture[str], more: list[str], message: str
) -> None:
    assert batch("--vary", *more) == 2
    assert message in capsys.readouterr().err.splitlines()[-1]
    assert not Path("out").exists()
