"""Which layer to cut at for the spacing of the sparse points."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from pnpdepth_cli.models.network import Network, load_network
from pnpdepth_cli.models.rank_layers import (
    MeasuredLayer,
    best_layer,
    measure_layers,
    point_spacing,
    rank_layers,
)

IMAGE = torch.rand(1, 3, 64, 96, generator=torch.Generator().manual_seed(0))


def layer(name: str, field: int, cost: float) -> MeasuredLayer:
    return MeasuredLayer(name=name, field_in_output=(field, field + 4), cost_behind=cost)


LAYERS = [
    layer("deep", 90, 0.9),
    layer("middle", 40, 0.5),
    layer("late", 9, 0.1),
    MeasuredLayer(name="never", problem="never runs"),
]


@pytest.mark.parametrize(
    ("spacing", "ranks"),
    [(30, [2, 1, 3, None]), (100, [1, 2, 3, None]), (5, [3, 2, 1, None])],
)
def test_the_cheapest_layer_whose_field_spans_the_gap_comes_first(
    spacing: float, ranks: list[int | None]
) -> None:
    assert [one.rank for one in rank_layers(LAYERS, spacing)] == ranks


def test_evenly_spread_points_are_apart_by_the_root_of_the_area_of_each() -> None:
    assert point_spacing((100, 400), 100) == 20


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


def test_few_points_want_a_deep_layer_and_many_a_late_one(network: Network) -> None:
    assert best_layer(network, (IMAGE,), (64, 96), 20) == "deep"
    assert best_layer(network, (IMAGE,), (64, 96), 64 * 96) == "late"
    assert best_layer(network, (IMAGE,), (64, 96), 0) is None


def test_a_layer_that_cannot_be_cut_at_is_measured_as_a_problem(network: Network) -> None:
    seen: list[tuple[int, int]] = []
    layers = measure_layers(
        network, ["deep", "nowhere"], (IMAGE,), (64, 96), lambda *counts: seen.append(counts)
    )
    assert seen == [(1, 2), (2, 2)]
    assert layers[0].stride == 16
    assert "nowhere" in (layers[1].problem or "")
