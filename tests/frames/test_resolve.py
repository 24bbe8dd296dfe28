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


@pytest.mark.parametrize(
    ("errors", "expected"),
    [
        ({"unit": 0.064, "imagenet": 0.062, "symmetric": 0.07, "bytes": 0.3}, ("unit", "imagenet")),
        ({"unit": 0.06, "imagenet": 0.15, "symmetric": 0.2, "bytes": 0.3}, ("unit", None)),
        ({"unit": 0.2, "imagenet": 0.05, "symmetric": 0.15, "bytes": 0.3}, ("imagenet", None)),
        ({"unit": 0.2, "imagenet": 0.05, "symmetric": 0.06, "bytes": 1}, ("imagenet", "symmetric")),
    ],
)
def test_0_to_1_is_kept_unless_clearly_beaten(
    errors: dict[str, float], expected: tuple[str, str | None]
) -> None:
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


@pytest.mark.parametrize(
    ("build", "is_default", "expected"),
    [
        (Brightness, False, (9, "none")),
        (Brightness, True, (5, "auto")),
        (Nearest, False, (9, "none")),
        (Nearest, True, (0, "none")),
    ],
)
def test_the_default_method_updates_little_and_aligns_what_sees_the_image_alone(
    build: type[Brightness | Nearest], is_default: bool, expected: tuple[int, str]
) -> None:
    asked, network = Settings(iterations=9, align="none", layer="layer"), member(build).network
    found = resolve_member(network, frame_in_memory(), asked, is_default=is_default).settings
    assert (found.iterations, found.align) == expected
