"""The input range of a network that states none."""

from __future__ import annotations

import numpy as np
import pytest

from pnpdepth_cli.frames.resolve import NORMALISATIONS, choose_input_range


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
