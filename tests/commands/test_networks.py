"""The layers that `pnpdepth layers` lists."""

from __future__ import annotations

from pathlib import Path

from pnpdepth_cli.commands.networks import list_layers
from pnpdepth_cli.commands.refinement.refine_request import NetworkChoice

SOURCE = """
from torch import nn
from pnpdepth_cli.models.definition import ModelDefinition, Multiple

definition = ModelDefinition(
    name="net", input_kind="rgb", size=Multiple(16), complete=True, layers=("0", "nowhere"),
    build=lambda: nn.Sequential(nn.Conv2d(3, 4, 16, 16), nn.ConvTranspose2d(4, 1, 16, 16)),
)
"""


def test_a_layer_that_cannot_be_cut_at_is_listed_with_its_problem(tmp_path: Path) -> None:
    (tmp_path / "net.py").write_text(SOURCE)
    seen: list[tuple[int, int]] = []
    choice = NetworkChoice(model=str(tmp_path / "net.py"))
    layers = list_layers(choice, every=False, on_layer=lambda *counts: seen.append(counts))
    assert seen == [(1, 2), (2, 2)]
    assert layers[0].stride == 16
    assert "nowhere" in (layers[1].problem or "")
