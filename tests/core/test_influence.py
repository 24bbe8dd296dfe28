"""The influential field, where it can be counted by hand."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from pnpdepth_cli.core.influence import Patch, influential_field
from pnpdepth_cli.core.split import Split
from tests.core.networks import Net, conv, image


def field(network: nn.Module, layer: str, size: int = 32) -> tuple[Patch | None, Patch]:
    with Split(network, layer) as split:
        z = split.front(image(size, size))
        return influential_field(split, z, lambda output: output)


@pytest.mark.parametrize(
    ("stride", "patches"),
    [
        (1, ((5, 5), (9, 9))),
        # 3×3 of the strided map read 7×7 of z; those move (7 + 2) / 2 + 1 = 5 cells, widened to 7
        (2, ((7, 7), (7, 7))),
    ],
)
def test_two_3x3_convolutions_reach_as_far_as_counted(stride: int, patches: object) -> None:
    torch.manual_seed(0)
    network = nn.Sequential(conv(3, 4), conv(4, 4, stride=stride), conv(4, 1))
    assert field(network, "0") == patches


def test_tokens_that_are_mixed_reach_everywhere_and_have_no_patch() -> None:
    tokens = [conv(3, 8, 3, stride=4), nn.Flatten(2), nn.Linear(16, 16)]
    network = nn.Sequential(*tokens, nn.Unflatten(2, (4, 4)), conv(8, 1))
    assert field(network, "1", 16) == (None, (4, 4))


def test_a_cut_that_does_not_reach_the_output_has_no_field() -> None:
    parts = {"cut": conv(3, 4), "head": conv(3, 1)}
    network = Net(lambda net, x: (net.cut(x), net.head(x))[1], **parts)
    assert field(network, "cut") == ((0, 0), (0, 0))


@pytest.mark.parametrize(("enough", "tried"), [(None, 3), (1, 1), (2, 3), (3, 1)])
def test_points_are_tried_until_the_narrower_side_is_enough_or_far_from_it(
    enough: float | None, tried: int
) -> None:
    network = nn.Sequential(conv(3, 4), nn.Conv2d(4, 1, (3, 1), padding=(1, 0)))
    calls = list[object]()

    def counted(output: torch.Tensor) -> torch.Tensor:
        calls.append(output)
        return output

    with Split(network, "0") as split:
        found = influential_field(split, split.front(image(32, 32)), counted, enough)
    assert found == ((3, 1), (5, 1))
    assert len(calls) == 1 + tried
