"""The notebook among the samples runs as it is."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

SAMPLES = Path(__file__).parents[1] / "samples"


def test_the_notebook_runs_and_its_result_is_better_than_the_network(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    pytest.importorskip("matplotlib").use("agg")
    monkeypatch.chdir(SAMPLES)
    cells = json.loads((SAMPLES / "tour.ipynb").read_text())["cells"]
    names: dict[str, Any] = {}
    for cell in cells:
        assert not cell.get("outputs")
        if cell["cell_type"] == "code":
            exec(compile("".join(cell["source"]), "tour.ipynb", "exec"), names)
    refined, truth, known = names["refined"], names["truth"], names["truth"] > 0
    before, after = (abs(d - truth)[known].mean() for d in (refined.before, refined.depth))
    assert after < 0.1 * before
