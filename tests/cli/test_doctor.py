"""`doctor` from the command line."""

from __future__ import annotations

import re
from importlib import metadata
from pathlib import Path

import pytest

from pnpdepth_cli.cli.main import run


def test_doctor_reports_versions_what_is_missing_and_a_refined_plane(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    required = ["torch", "none-such>=1", 'none-other; extra == "plot"', 'pytest; extra == "test"']
    monkeypatch.setattr(metadata, "requires", lambda _: required)
    assert run(["doctor"]) == 0
    out = capsys.readouterr().out
    assert f"torch {metadata.version('torch')}\n" in out
    assert "none-such not installed\n" in out
    assert "none-other not installed, of the extra plot\n" in out
    assert "pytest" not in out
    error = re.search(r"self-test +passed; a plane refined in [\d.]+ s, MAE ([\d.]+) m", out)
    assert error is not None
    assert float(error[1]) < 0.02


def test_doctor_shows_and_clears_what_was_decided_about_networks(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("PNPDEPTH_CACHE", str(tmp_path))
    (tmp_path / "0123.json").write_text("{}")
    (tmp_path / "mine.txt").write_text("of the user")
    assert run(["doctor"]) == 0
    assert "decisions about 1 network," in capsys.readouterr().out
    assert run(["doctor", "--clear-cache"]) == 0
    assert "decisions about 0 networks," in capsys.readouterr().out
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]
