"""`doctor` from the command line."""

from __future__ import annotations

import re
from importlib import metadata
from pathlib import Path

import pytest

from pnpdepth_cli.cli.main import run
from tests.command_line import printed


@pytest.fixture(scope="module")
def shown() -> str:
    """What `doctor` prints where two of the required packages are not installed."""
    required = ["torch", "none-such>=1", 'none-other; extra == "plot"', 'pytest; extra == "test"']
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(metadata, "requires", lambda _: required)
        done = printed("doctor")
    assert done.code == 0
    return done.out


def test_doctor_shows_the_versions_of_what_is_installed(shown: str) -> None:
    assert f"torch {metadata.version('torch')}\n" in shown


def test_doctor_names_what_is_missing_with_the_extra_that_installs_it(shown: str) -> None:
    assert "none-such not installed\n" in shown
    assert "none-other not installed, of the extra plot\n" in shown


def test_doctor_says_nothing_of_packages_for_the_tests(shown: str) -> None:
    assert "pytest" not in shown


def test_doctor_refines_a_plane_and_shows_its_error(shown: str) -> None:
    error = re.search(r"self-test +passed; .* MAE ([\d.]+) m", shown)
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
