"""Fixtures of all tests."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from hypothesis import settings

settings.register_profile("steady", deadline=None, derandomize=True)
settings.load_profile("steady")


@pytest.fixture
def shared_data() -> Path:
    """The real frames and weights beside the checkout; the test is skipped where they are not."""
    folder = Path(__file__).resolve().parents[2] / "shared" / "data"
    if not folder.is_dir():
        pytest.skip("needs the real frames in ../shared/data")
    return folder


@pytest.fixture
def seeded() -> torch.Generator:
    """torch's random numbers start from one place; a generator of its own at that place too."""
    torch.manual_seed(0)
    return torch.Generator().manual_seed(0)
