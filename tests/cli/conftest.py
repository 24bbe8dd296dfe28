"""Fixtures of the tests of commands."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.commands.batches import pairs_on_disk


@pytest.fixture
def root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder drive/ with two frames, in the current folder."""
    monkeypatch.chdir(tmp_path)
    return pairs_on_disk(tmp_path / "drive", ("a", "b"))
