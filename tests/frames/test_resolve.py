"""What the user and the definition leave open, resolved."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import nn

from pnpdepth_cli.choices import NORMALISATIONS
from pnpdepth_cli.errors import UsageError
from pnpdepth_cli.frames.resolve import (
    choose_input_range,
    default_layer,
    normalisation_name,
    resolve_layer,
    resolve_member,
    wanted_field,
)
from pnpdepth_cli.models.definition import ModelDefinition, Multiple, Normalisation
from pnpdepth_cli.models.network import load_network
from pnpdepth_cli.settings import Settings
from tests.frames.scenes import Brightness, Nearest, frame_in_memory, member


def test_0_to_1_is_kept_unless_clearly_beaten() -> None:
    for unit, imagenet, symmetric, expected in (
        (0.064, 0.062, 0.07, ("unit", "imagenet")),
        (0.06, 0.15, 0.2, ("unit", None)),
        (0.2, 0.05, 0.15, ("imagenet", None)),
        (0.2, 0.05, 0.06, ("imagenet", "symmetric")),
    ):
        errors = {"unit": unit, "imagenet": imagenet, "symmetric": symmetric, "bytes": 0.3}
        assert choose_input_range(errors) == expected


def test_the_ranges_are_those_of_their_names() -> None:
    ends = np.array([[0.0], [1.0]])
    ranges = {name: (ends - how.mean) / how.std for name, how in NORMALISATIONS.items()}
    for name, (low, high) in {"unit": (0, 1), "symmetric": (-1, 1), "bytes": (0, 255)}.items():
        assert ranges[name].tolist() == [[low] * 3, [high] * 3]
    assert ranges["imagenet"][1].round(3).tolist() == [2.249, 2.429, 2.64]  # as is often printed


def test_an_input_range_is_told_by_its_name_if_it_has_one_and_the_network_takes_an_image() -> None:
    own = ModelDefinition(name="mine", build=Brightness, input_kind="rgb", size=Multiple(4))
    for name, normalisation in NORMALISATIONS.items():
        assert normalisation_name(replace(own, normalisation=normalisation)) == name
    of_nobody = Normalisation(mean=(0.1, 0.2, 0.3))
    assert normalisation_name(replace(own, normalisation=of_nobody)) is None
    assert normalisation_name(replace(own, build=Nearest, input_kind="sparse")) is None


def test_a_fraction_is_the_nearest_of_the_layers_that_the_definition_lists() -> None:
    definition = replace(member(Brightness).network.definition, layers=tuple("abcde"))
    asked = (None, "0", "0.12", "0.13", "0.87", "1", "x.y")
    assert [resolve_layer(definition, layer) for layer in asked] == [*"aaabd", "e", "x.y"]
    nothing = replace(definition, layers=())
    for unlisted, layer in ((nothing, None), (nothing, "0"), (definition, "1.01")):
        with pytest.raises(UsageError):
            resolve_layer(unlisted, layer)


def test_what_is_left_open_serves_a_propagated_result_and_what_is_stated_is_obeyed() -> None:
    frame = frame_in_memory()
    stated = Settings(layer="layer", iterations=9, align="none")
    left_open = Settings(layer="layer")
    paper = Settings(layer="layer", method="paper")
    for build, asked, expected in (
        (Brightness, left_open, (5, "auto", False)),
        (Nearest, left_open, (0, "none", False)),
        (Brightness, stated, (9, "none", True)),
        (Nearest, stated, (9, "none", True)),
        (Brightness, paper, (5, "none", True)),
    ):
        found = resolve_member(member(build).network, frame, asked)
        settings = found.settings
        assert (settings.iterations, settings.align, found.always_updated) == expected


def test_a_field_spans_several_gaps_between_points_and_half_the_image() -> None:
    assert wanted_field((100, 400), 100) == 120
    assert wanted_field((100, 400), 10_000) == 50


@pytest.mark.parametrize(("points", "layer"), [(20, "0"), (1536, "2"), (0, "0")])
def test_few_points_want_a_deep_layer_unless_one_is_stated(points: int, layer: str) -> None:
    torch.manual_seed(0)
    # a layer at stride 16, and one at full size whose field is 17 pixels wide
    late = nn.ConvTranspose2d(4, 4, 16, stride=16), nn.Conv2d(4, 4, 3, padding=1)
    layers = nn.Conv2d(3, 4, 16, stride=16), *late, nn.Conv2d(4, 1, 9, padding=4)
    definition = ModelDefinition(
        name="net", input_kind="rgb", size=Multiple(16), build=lambda: nn.Sequential(*layers),
        complete=True, layers=("0", "2"),
    )  # fmt: skip
    network = load_network(definition, None)
    assert default_layer(network, (32, 48), points) == layer
    for stated in ({"layers": ("2",)}, {"defaults": Settings(layer="2")}):
        definition = replace(network.definition, **stated)
        assert default_layer(replace(network, definition=definition), (32, 48), points) == "2"
