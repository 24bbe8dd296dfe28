"""Which layer to cut at for the spacing of the sparse points."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from pnpdepth_cli.models import measure_layers as measuring
from pnpdepth_cli.models.measure_layers import (
    best_layer,
    default_layer,
    measure_layers,
    point_spacing,
    wanted_field,
)
from pnpdepth_cli.models.network import Network, load_network
from pnpdepth_cli.settings import Settings

IMAGE = torch.rand(1, 3, 64, 96, generator=torch.Generator().manual_seed(0))


def test_a_field_spans_several_gaps_between_points_and_half_the_image() -> None:
    assert point_spacing((100, 400), 100) == 20
    assert wanted_field((100, 400), 20) == 120
    assert wanted_field((100, 400), 2) == 50


SOURCE = """
import torch
from torch import nn
from pnpdepth_cli.models.definition import ModelDefinition, Multiple

class Net(nn.Module):
    def __init__(self):
        super().__init__()
        torch.manual_seed(0)
        self.deep = nn.Conv2d(3, 4, 16, stride=16)
        self.up = nn.ConvTranspose2d(4, 4, 16, stride=16)
        self.late = nn.Conv2d(4, 4, 3, padding=1)
        self.head = nn.Conv2d(4, 1, 1)

    def forward(self, rgb):
        return self.head(self.late(self.up(self.deep(rgb)))) + 5

definition = ModelDefinition(
    name="net",
    input_kind="rgb",
    size=Multiple(16),
    build=Net,
    layers=("deep", "late"),
    complete=True,
)
"""


@pytest.fixture
def network(tmp_path: Path) -> Network:
    (tmp_path / "net.py").write_text(SOURCE)
    return load_network(str(tmp_path / "net.py"), None)


def test_few_points_want_a_deep_layer_and_many_a_late_one(
    network: Network, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(measuring, "LEAST_FRACTION", 0.0)
    assert best_layer(network, (IMAGE,), (64, 96), 20) == "deep"
    assert best_layer(network, (IMAGE,), (1, 1), 36) == "late"
    assert best_layer(network, (IMAGE,), (64, 96), 0) is None


def test_the_default_is_the_definitions_layer_else_the_best_one(network: Network) -> None:
    assert default_layer(network, (160, 192), 50) == "deep"
    named = replace(network.definition, defaults=Settings(layer="late"))
    assert default_layer(replace(network, definition=named), (160, 192), 50) == "late"


def test_a_layer_that_cannot_be_cut_at_is_measured_as_a_problem(network: Network) -> None:
    seen: list[tuple[int, int]] = []
    layers = measure_layers(
        network, ["deep", "nowhere"], (IMAGE,), (64, 96), lambda *counts: seen.append(counts)
    )
    assert seen == [(1, 2), (2, 2)]
    assert layers[0].stride == 16
    assert "nowhere" in (layers[1].problem or "")
