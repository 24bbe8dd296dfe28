"""Fixtures of all tests."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
import torch
from hypothesis import settings

settings.register_profile("steady", deadline=None, derandomize=True)
settings.load_profile("steady")

_SHARED_DATA = Path(__file__).resolve().parents[2] / "shared" / "data"


@pytest.fixture
def shared_data() -> Path:
    """The folder with real frames and weights, named by PNPDEPTH_TEST_DATA; skips without it."""
    folder = Path(os.environ.get("PNPDEPTH_TEST_DATA", _SHARED_DATA))
    if not folder.is_dir():
        pytest.skip(f"needs real frames in {folder}; name their folder in PNPDEPTH_TEST_DATA")
    return folder


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Marks the tests that need the real frames, so that -m "not shared_data" leaves them out."""
    for item in items:
        if "shared_data" in getattr(item, "fixturenames", ()):
            item.add_marker(pytest.mark.shared_data)


@pytest.fixture
def seeded() -> torch.Generator:
    """torch's random numbers start from one place; a generator of its own at that place too."""
    torch.manual_seed(0)
    return torch.Generator().manual_seed(0)
