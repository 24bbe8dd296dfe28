"""Weights that do not fit are compared with few known networks, since building all takes long."""

from __future__ import annotations

import pytest

from pnpdepth_cli.models import registry

KNOWN = ["eigen", "sparse2dense-tiny", "sparse2dense-tiny-kitti"]


@pytest.fixture(autouse=True)
def few_networks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(registry, "names", lambda: KNOWN)
