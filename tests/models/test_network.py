"""A network ready to run: its arguments, its depth, its device; never random weights in silence."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import save_file
from torch import nn

from pnpdepth_cli.errors import DeviceError, ModelError
from pnpdepth_cli.models.definition import Multiple, Normalisation
from pnpdepth_cli.models.frame_map import FrameMap
from pnpdepth_cli.models.network import (
    FARTHEST_DEPTH,
    find_device,
    load_network,
)
from pnpdepth_cli.points import SparsePoints
from tests.models.definitions import definition, network


def test_an_image_is_normalised_and_points_are_scattered() -> None:
    normalisation = Normalisation(mean=(0.5, 0.25, 0.0), std=(0.5, 0.25, 2.0))
    of = network(input_kind="rgb+sparse", normalisation=normalisation)
    image = of.image_of(FrameMap.fit(Multiple(1), 2, 3), torch.full((1, 3, 2, 3), 0.5))
    xy = torch.tensor([[0.0, 0.0], [2.0, 1.0]])
    points = SparsePoints(xy=xy, depth=torch.tensor([4.0, 2.0]), size=(2, 3))
    rgb, sparse = of.arguments_of(image, points)
    assert rgb[0, :, 0, 0].tolist() == [0.0, 1.0, 0.25]
    assert sparse.tolist() == [[[[4, 0, 0], [0, 0, 2]]]]


def test_one_depth_map_in_any_shape_is_depth_and_any_other_output_is_refused() -> None:
    for shape in ((1, 1, 2, 3), (1, 2, 3), (2, 3)):
        depth = network().depth_of(torch.full(shape, 2.0, dtype=torch.float64))
        assert depth.dtype == torch.float32
        assert torch.equal(depth, torch.full((1, 1, 2, 3), 2.0))
    for shape in ((2, 1, 2, 3), (1, 2, 2, 3), (3,), (), (1, 1, 1, 2, 3)):
        with pytest.raises(ModelError):
            network().depth_of(torch.zeros(shape))


def test_inverse_and_log_depth_become_metres() -> None:
    inverse = network(output_kind="inverse").depth_of(torch.tensor([[0.5, 4.0, 0.0, -1.0]]))
    assert inverse.flatten().tolist() == pytest.approx([2.0, 0.25, FARTHEST_DEPTH, FARTHEST_DEPTH])
    logarithm = network(output_kind="log").depth_of(torch.tensor([[0.0, 1.0]]))
    assert logarithm.flatten().tolist() == pytest.approx([1.0, 2.718281828])


def test_the_only_tensor_of_a_structure_is_the_output_and_several_need_a_choice() -> None:
    depth = torch.ones(1, 1, 2, 2)
    assert torch.equal(network().depth_of({"depth": [depth], "text": "x"}), depth)
    with pytest.raises(ModelError):
        network().depth_of({"a": depth, "b": [depth]})
    chosen = network(output=lambda output: output["b"][0])
    assert torch.equal(chosen.depth_of({"a": 2 * depth, "b": [depth]}), depth)


def test_weights_come_from_the_named_file_or_the_definition_never_by_chance(tmp_path: Path) -> None:
    weights = tmp_path / "own.safetensors"
    save_file({"weight": torch.full((1, 1, 1, 1), 3.0), "bias": torch.ones(1)}, weights)
    bare = definition(build=lambda: nn.Conv2d(1, 1, 1), layers=("",))
    owned = replace(bare, checkpoint=weights)
    for spec, checkpoint in ((owned, None), (bare, weights)):
        loaded = load_network(spec, checkpoint)
        assert float(loaded.module.weight) == 3  # type: ignore[arg-type]
        assert not loaded.module.training
        assert not any(p.requires_grad for p in loaded.module.parameters())
        assert loaded.checkpoint == weights
    weights.unlink()
    for spec in (bare, owned):
        with pytest.raises(ModelError):
            load_network(spec, None)


@pytest.mark.parametrize("build", [lambda: 1 / 0, lambda: "text", nn.Conv2d(1, 1, 1)])
def test_a_build_that_raises_or_returns_no_module_is_refused(build: Callable[..., Any]) -> None:
    with pytest.raises(ModelError, match="build of network 'n'"):
        load_network(definition(build=build), None)


@pytest.mark.parametrize("name", ["cuda:99", "meta", "nonsense"])
def test_a_missing_device_is_refused_in_one_line(name: str) -> None:
    with pytest.raises(DeviceError, match=r"\A.+\Z"):
        find_device(name)
