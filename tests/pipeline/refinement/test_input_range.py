"""The input range of a network that states none."""

from __future__ import annotations

import pytest

from pnpdepth_cli.pipeline.refinement.resolve import chosen_input_range


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
    assert chosen_input_range(errors) == expected
