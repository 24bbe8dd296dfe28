"""Fixtures of all tests."""

from __future__ import annotations

import os
import secrets
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
import torch
from hypothesis import settings
from tqdm import tqdm

if TYPE_CHECKING:
    from tests.commands.frames import FrameOnDisk

tqdm.monitor_interval = 0  # beside its thread, what libraries print cannot be silenced
settings.register_profile("steady", deadline=None, derandomize=True)
settings.load_profile("steady")

if "PYTEST_XDIST_WORKER" in os.environ:
    # two workers and what they start have a thread each, unless OMP_NUM_THREADS asks for more
    torch.set_num_threads(int(os.environ.setdefault("OMP_NUM_THREADS", "1")))

SLOW_FIXTURES = {"chrome", "shared_data"}
"""A test that uses one of them belongs to the second tier."""


def pytest_addoption(parser: pytest.Parser) -> None:
    text = "change the results of torch's products as another processor could"
    parser.addoption("--rounding", action="store_true", help=text)


def pytest_configure(config: pytest.Config) -> None:
    if config.getoption("--rounding"):
        from tests.rounding import enter_in_every_thread

        enter_in_every_thread()


@pytest.fixture(scope="session", autouse=True)
def _cache_of_shared_fixtures(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """What fixtures of a whole module decide about networks is not in the user's folder either."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PNPDEPTH_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture(autouse=True)
def _own_cache(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    """What a test decides about networks is kept for it alone, not in the user's folder."""
    monkeypatch.setenv("PNPDEPTH_CACHE", str(tmp_path_factory.getbasetemp() / secrets.token_hex(6)))


@pytest.fixture
def shared_data() -> Path:
    """The folder with real frames and weights, named by PNPDEPTH_TEST_DATA; skips without it."""
    beside = Path(__file__).resolve().parents[2] / "shared" / "data"
    folder = Path(os.environ.get("PNPDEPTH_TEST_DATA", beside))
    if not folder.is_dir():
        pytest.skip(f"needs real frames in {folder}; name their folder in PNPDEPTH_TEST_DATA")
    return folder


@pytest.fixture
def frame(tmp_path: Path) -> FrameOnDisk:
    """A small frame and a small network on disk, in tmp_path."""
    from tests.commands.frames import frame_on_disk

    return frame_on_disk(tmp_path)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if SLOW_FIXTURES.intersection(getattr(item, "fixturenames", ())):
            item.add_marker(pytest.mark.slow)


@pytest.fixture
def root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder drive/ with two frames, in the current folder."""
    from tests.commands.batches import pairs_on_disk

    monkeypatch.chdir(tmp_path)
    return pairs_on_disk(tmp_path / "drive", ("a", "b"))
