"""What the user and the definition leave open, resolved."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pnpdepth_cli.errors import UsageError
from pnpdepth_cli.frames.resolve import (
    NORMALISATIONS,
    choose_input_range,
    resolve_layer,
    resolve_member,
)
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


def test_a_fraction_is_the_nearest_of_the_layers_that_the_definition_lists() -> None:
    definition = replace(member(Brightness).network.definition, layers=tuple("abcde"))
    asked = (None, "0", "0.12", "0.13", "0.87", "1", "x.y")
    assert [resolve_layer(definition, each) for each in asked] == [*"aaabd", "e", "x.y"]
    nothing = replace(definition, layers=())
    for unlisted, layer in ((nothing, None), (nothing, "0"), (definition, "1.01")):
        with pytest.raises(UsageError):
            resolve_layer(unlisted, layer)


def test_the_default_method_updates_little_and_aligns_what_sees_the_image_alone() -> None:
    asked, frame = Settings(iterations=9, align="none", layer="layer"), frame_in_memory()
    for build, method in ((Brightness, (5, "auto")), (Nearest, (0, "none"))):
        for is_default, expected in ((True, method), (False, (9, "none"))):
            network = member(build).network
            found = resolve_member(network, frame, asked, is_default=is_default).settings
            assert (found.iterations, found.align) == expected
