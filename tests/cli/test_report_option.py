"""`--html` of batch and eval as a user has it."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.cli.test_score_commands import code_of

BATCH = (
    *("batch", "drive", "-o", "out", "--model", "drive/net/my_net.py"),
    *("--checkpoint", "drive/net/my_net.safetensors"),
)


def test_an_evaluation_replaces_a_report_only_if_asked(
    root: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ("eval", "drive/gt", "drive/gt", "--html")
    assert code_of(*arguments, "scores") == 0
    before = Path("scores/index.html").stat().st_mtime_ns
    capsys.readouterr()
    assert code_of(*arguments, "scores") == 2
    assert capsys.readouterr().err == (
        "pnpdepth: scores is not empty; --overwrite replaces the report in it, or name another"
        " folder\n"
    )
    assert Path("scores/index.html").stat().st_mtime_ns == before
    assert code_of(*arguments, "scores", "--overwrite") == 0
    assert Path("scores/index.html").stat().st_mtime_ns > before


@pytest.mark.parametrize("folder", ["drive/gt", "drive/gt/report", "drive", "."])
def test_an_evaluation_writes_neither_into_its_inputs_nor_around_them(
    root: Path, capsys: pytest.CaptureFixture[str], folder: str
) -> None:
    before = sorted(root.rglob("*"))
    assert code_of("eval", "drive/gt", "drive/gt", "--html", folder, "--overwrite") == 2
    out, err = capsys.readouterr()
    assert (out, err.count("\n")) == ("", 1)
    assert "which is read; name another folder" in err
    assert sorted(root.rglob("*")) == before


def test_a_report_that_cannot_be_written_is_refused(root: Path) -> None:
    Path("file").write_text("mine")
    for command in (BATCH, ("eval", "drive/gt", "drive/gt")):
        assert code_of(*command, "--html", "file/report") == 2
