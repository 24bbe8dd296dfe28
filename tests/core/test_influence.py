from __future__ import annotations

import pytest
import torch
from torch import nn

from pnpdepth_cli.core.influence import Patch, influential_field
from pnpdepth_cli.core.split import Split
from tests.core.networks import Counting, Net, conv, image


def field(network: nn.Module, layer: str) -> tuple[Patch | None, Patch]:
    with Split(network, layer) as split:
        return influential_field(split, split.front(image(32, 32)), lambda output: output)


def test_a_field_is_as_wide_as_counted_if_it_has_a_patch() -> None:
    torch.manual_seed(0)
    one, two = (nn.Sequential(conv(3, 4), conv(4, 4, stride=n), conv(4, 1)) for n in (1, 2))
    assert field(one, "0") == ((5, 5), (9, 9))
    # 3×3 of the strided map read 7×7 of z; those move (7 + 2) / 2 + 1 = 5 cells, widened to 7
    assert field(two, "0") == ((7, 7), (7, 7))
    mixed = (conv(3, 8, stride=8), nn.Flatten(2), nn.Linear(16, 16))
    assert field(nn.Sequential(*mixed, nn.Unflatten(2, (4, 4)), conv(8, 1)), "1") == (None, (4, 4))
    unread = Net(lambda net, x: (net.cut(x), net.head(x))[1], cut=conv(3, 4), head=conv(3, 1))
    assert field(unread, "cut") == ((0, 0), (0, 0))


@pytest.mark.parametrize(("enough", "tried"), [(None, 3), (1, 1), (2, 3), (3, 1)])
def test_points_are_tried_until_a_side_is_enough_or_far(enough: float | None, tried: int) -> None:
    network = nn.Sequential(conv(3, 4), nn.Conv2d(4, 1, (3, 1), padding=(1, 0)))
    counted = Counting(nn.Identity())
    with Split(network, "0") as split:
        found = influential_field(split, split.front(image(32, 32)), counted, enough)
    assert found == ((3, 1), (5, 1))
    assert counted.calls == 1 + tried
