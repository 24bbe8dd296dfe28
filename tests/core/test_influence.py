from __future__ import annotations

import pytest
import torch
import torch.nn.functional as F
from torch import nn

from pnpdepth_cli.core.influence import Patch, influential_fields
from pnpdepth_cli.core.split import Split
from tests.core.networks import Net, conv, image


def field(network: nn.Module, layer: str) -> tuple[Patch | None, Patch]:
    fields = influential_fields(network.eval(), (image(32, 32),), [layer], lambda output: output)
    return fields[layer].in_z, fields[layer].in_output


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


class Attention(nn.Module):
    """Each pixel looks at every other one."""

    def __init__(self) -> None:
        super().__init__()
        self.inner = nn.MultiheadAttention(4, 2, batch_first=True)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        tokens = x.flatten(2).transpose(1, 2)
        return self.inner(tokens, tokens, tokens)[0].transpose(1, 2).unflatten(2, x.shape[2:])


def gather_largest(x: torch.Tensor) -> torch.Tensor:
    """The map at the largest values of its windows, as pooling of confidences takes it."""
    _, indices = F.max_pool2d(x, 2, return_indices=True)
    return x.flatten(2).gather(2, indices.flatten(2)).reshape(indices.shape)


def shuffled_patches(x: torch.Tensor) -> torch.Tensor:
    patches = x.reshape(1, 4, 8, 4, 8, 4).permute(0, 1, 2, 4, 3, 5)
    return patches.permute(0, 1, 2, 4, 3, 5).reshape(1, 4, 32, 32)


def in_place(x: torch.Tensor) -> torch.Tensor:
    y = torch.zeros(1, 4, 34, 34)
    y[:, :, 1:-1, 1:-1] = x
    y.mul_(2)
    return y[..., 1:-1, 1:-1].relu_()


RANDOM = torch.rand((32, 32), generator=torch.Generator().manual_seed(0))

BEHIND = {
    "pooling": lambda x: F.avg_pool2d(F.max_pool2d(x, 3, 2, 1), 2),
    "resizing": lambda x: F.interpolate(x, scale_factor=2, mode="bilinear"),
    "corners": lambda x: F.interpolate(x, (48, 40), mode="bicubic", align_corners=True),
    "nearest": lambda x: F.interpolate(x, scale_factor=1.5),
    "shrinking": lambda x: F.interpolate(x, (20, 12), mode="bilinear", antialias=True),
    "adaptive": lambda x: F.adaptive_avg_pool2d(x, (9, 7)),
    "reflection": lambda x: F.pad(x, (1, 2, 3, 4), mode="reflect"),
    "cropping": lambda x: x[:, :, 4:, ::2],
    "stacking": lambda x: torch.stack([x, -x], dim=3).reshape(1, 4, 64, 32),
    "joining": lambda x: torch.cat([x, x.flip(1)], dim=1)[:, 2:6],
    "repeating": lambda x: x[:, :2].repeat(1, 2, 1, 1),
    "squeezing": lambda x: x * x.mean((2, 3), keepdim=True).sigmoid(),
    "normalising": lambda x: F.layer_norm(x.permute(0, 2, 3, 1), (4,)).permute(0, 3, 1, 2),
    "instances": lambda x: F.group_norm(x, 2),
    "patches": shuffled_patches,
    "products": lambda x: (x.permute(0, 2, 3, 1) @ torch.ones(4, 4)).permute(0, 3, 1, 2),
    "columns": lambda x: RANDOM @ x,
    "rows": lambda x: torch.bmm(x[0], RANDOM.expand(4, -1, -1))[None],
    "sums of products": lambda x: torch.baddbmm(x[0], RANDOM.expand(4, -1, -1), x[0])[None],
    "transposing": lambda x: x[0, 1].t().contiguous().t()[None, None].repeat(1, 4, 1, 1),
    "shares of rows": lambda x: x.softmax(2),
    "sums of columns": lambda x: x + x.sum(3, keepdim=True),
    "sums of channels": lambda x: x + x.sum(1),
    "the mean of all": lambda x: x + x.mean(),
    "splitting": lambda x: torch.cat(x.split(2, dim=1)[::-1], dim=1) + x.unbind(2)[3].mean(),
}
"""Functions of a map (1, 4, 32, 32) between two convolutions, by what they do."""


@pytest.mark.parametrize("name", BEHIND)
def test_a_field_is_that_of_gradients_and_changes(name: str) -> None:
    torch.manual_seed(0)
    net = Net(lambda net, x: net.head(BEHIND[name](net.cut(x))), cut=conv(3, 4), head=conv(4, 1))
    assert field(net, "cut") == measured(net, "cut")


def test_the_field_through_a_pooling_with_indices_is_known_along_the_rows() -> None:
    torch.manual_seed(0)
    net = Net(lambda net, x: net.head(gather_largest(net.cut(x))), cut=conv(3, 4), head=conv(4, 1))
    in_z, in_output = field(net, "cut")
    by_values = measured(net, "cut")
    assert in_z is not None
    assert (in_z[0], in_output[0]) == (by_values[0][0], by_values[1][0])


def test_a_field_is_at_most_a_pixel_wider_where_channels_become_pixels() -> None:
    torch.manual_seed(0)
    net = nn.Sequential(conv(3, 4), nn.PixelShuffle(2), conv(1, 1))
    assert (field(net, "0"), measured(net, "0")) == (((2, 2), (6, 6)), ((2, 2), (5, 5)))


def test_attention_reaches_the_whole_image() -> None:
    torch.manual_seed(0)
    net = nn.Sequential(conv(3, 4), Attention(), conv(4, 1))
    assert field(net, "0") == ((32, 32), (32, 32))
    assert field(net, "1") == ((3, 3), (5, 5))


def measured(net: nn.Module, layer: str) -> tuple[Patch, Patch]:
    """The field by values: where the gradient of a point is, and what changes with z there."""
    patches = []
    with Split(net, layer) as split:
        z = split.front(image(32, 32)).requires_grad_(True)
        depth = split.rear(z)
        for down, right in ((0.5, 0.5), (0.35, 0.4), (0.65, 0.6)):
            point = depth[0, 0, int(depth.shape[2] * down), int(depth.shape[3] * right)]
            (gradient,) = torch.autograd.grad(point, z, retain_graph=True)
            moved = split.rear(z.detach() + 0.1 * gradient.sign())
            patches.append((*extent(gradient), *extent(moved - depth)))
    height, width, rows, columns = (max(sizes) for sizes in zip(*patches, strict=True))
    return (height, width), (rows, columns)


def extent(values: torch.Tensor) -> Patch:
    _, _, rows, columns = values.detach().nonzero().unbind(1)
    return int(rows.max() - rows.min()) + 1, int(columns.max() - columns.min()) + 1
