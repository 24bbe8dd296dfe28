"""Which files a command may replace, and paths that lead nowhere."""

from __future__ import annotations

from pathlib import Path

import pytest

from pnpdepth_cli.cli.main import run
from pnpdepth_cli.commands.requests import check_outputs
from pnpdepth_cli.errors import OutputError

SAMPLES = Path(__file__).parents[2] / "samples"
INDOOR = SAMPLES / "indoor"
STREET = SAMPLES / "street"
PAIR = [INDOOR / "rgb.png", "--sparse", INDOOR / "sparse.png"]
SCAN = [STREET / "rgb.png", "--sparse", STREET / "000000.bin"]


@pytest.fixture
def loop(tmp_path: Path) -> Path:
    """A symbolic link to another one, which leads back."""
    first, second = tmp_path / "first.png", tmp_path / "second.png"
    first.symlink_to(second)
    second.symlink_to(first)
    return first


def test_an_input_is_not_replaced_whatever_its_path_is(tmp_path: Path) -> None:
    file = tmp_path / "a.png"
    file.touch()
    link = tmp_path / "link.png"
    link.symlink_to(file)
    with pytest.raises(OutputError, match="inputs"):
        check_outputs([link], [file], overwrite=True)


@pytest.mark.parametrize(
    "arguments",
    [
        ["refine", "LOOP", "--sparse", INDOOR / "sparse.png", "-o", "out.png"],
        ["refine", INDOOR / "rgb.png", "--sparse", "LOOP", "-o", "out.png"],
        ["refine", *PAIR, "--gt", "LOOP", "-o", "out.png"],
        ["refine", *SCAN, "--calib", "LOOP", "-o", "out.png"],
        ["batch", "LOOP", "-o", "out"],
        ["eval", "LOOP", INDOOR / "gt.png"],
        ["eval", INDOOR / "gt.png", "LOOP", "--csv", "out.csv"],
        ["compare", "LOOP", "LOOP", "--csv", "out.csv"],
        ["cloud", "LOOP", "-o", "out.ply", "--calib", "LOOP"],
        ["frames", "LOOP", "-o", "out"],
    ],
)
def test_a_loop_of_symbolic_links_is_an_input_error(
    arguments: list[str | Path], loop: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(loop.parent)
    assert run([str(loop) if word == "LOOP" else str(word) for word in arguments]) == 3


def test_a_file_is_written_in_place_of_a_loop_of_symbolic_links(loop: Path) -> None:
    check_outputs([loop], [INDOOR / "rgb.png"], overwrite=False)
