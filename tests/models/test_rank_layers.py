"""Which layer to cut at for the spacing of the sparse points."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from pnpdepth_cli.commands.networks.describe import list_layers
from pnpdepth_cli.commands.refinement.request import NetworkChoice
from pnpdepth_cli.io.depth import write_depth
from pnpdepth_cli.models import rank_layers as rank
from pnpdepth_cli.models.network import Network, load_network
from pnpdepth_cli.models.rank_layers import (
    MeasuredLayer,
    best_layer,
    default_layer,
    measure_layers,
    point_spacing,
    rank_layers,
    wanted_field,
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
    ("wanted", "ranks"), [(30, [2, 1, 3, None]), (100, [1, 2, 3, None]), (5, [3, 2, 1, None])]
)
def test_the_cheapest_layer_whose_field_is_wide_enough_comes_first(
    wanted: float, ranks: list[int | None]
) -> None:
    assert [one.rank for one in rank_layers(LAYERS, wanted)] == ranks


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
    monkeypatch.setattr(rank, "LEAST_FRACTION", 0.0)
    assert best_layer(network, (IMAGE,), (64, 96), 20) == "deep"
    assert best_layer(network, (IMAGE,), (1, 1), 36) == "late"
    assert best_layer(network, (IMAGE,), (64, 96), 0) is None


@pytest.mark.parametrize("count", [1, 9, 25, 100, 10_000, 60_000])
def test_the_best_of_eight_layers_is_found_by_measuring_few(
    network: Network, monkeypatch: pytest.MonkeyPatch, count: int
) -> None:
    fields = dict(zip("abxcdefgy", (60, 60, None, 44, 30, 16, 5, 2, None), strict=True))
    measured: list[str] = []

    def measure(network: Network, name: str, *_: object, **__: object) -> MeasuredLayer:
        measured.append(name)
        field = fields[name]
        return MeasuredLayer(name=name, field_in_output=None if field is None else (field, field))

    monkeypatch.setattr(rank, "_measure", measure)
    monkeypatch.setattr(rank, "LEAST_FRACTION", 0.0)
    network = replace(network, definition=replace(network.definition, layers=tuple(fields)))
    wanted = min(wanted_field((64, 64), point_spacing((64, 64), count)), 64)
    reaching = [name for name, field in fields.items() if field is not None and field >= wanted]
    expected = reaching[-1] if reaching else "a"
    best = best_layer(network, (IMAGE,), (64, 64), count)
    assert fields[best or ""] == fields[expected]
    assert len(measured) <= 5


@pytest.mark.parametrize("count", [50, 20_000])
def test_the_layer_of_the_default_is_the_one_that_layers_ranks_first(
    tmp_path: Path, network: Network, count: int
) -> None:
    size = (160, 192)
    depth = np.zeros(size[0] * size[1], np.float32)
    depth[np.random.default_rng(0).permutation(len(depth))[:count]] = 2.0
    write_depth(tmp_path / "s.npy", depth.reshape(size), scale=1)
    choice = NetworkChoice(model=str(tmp_path / "net.py"))
    listed = list_layers(choice, every=False, sparse=tmp_path / "s.npy")
    (first,) = [row.name for row in listed.rows if row.rank == 1]
    assert default_layer(network, size, count) == first


def test_a_layer_that_cannot_be_cut_at_is_measured_as_a_problem(network: Network) -> None:
    seen: list[tuple[int, int]] = []
    layers = measure_layers(
        network, ["deep", "nowhere"], (IMAGE,), (64, 96), lambda *counts: seen.append(counts)
    )
    assert seen == [(1, 2), (2, 2)]
    assert layers[0].stride == 16
    assert "nowhere" in (layers[1].problem or "")
