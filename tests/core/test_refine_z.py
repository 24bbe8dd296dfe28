"""Equations 2 and 3, against a refinement that runs the whole network every time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from pnpdepth_cli.choices import UPDATES
from pnpdepth_cli.core.refine_z import Refinement, refine
from pnpdepth_cli.core.split import Split
from pnpdepth_cli.errors import DivergedError, ModelError
from pnpdepth_cli.points import SparsePoints
from pnpdepth_cli.settings import ClosedSettings
from tests.completion.naive import naive_refine, plain
from tests.core.networks import Counting, Net, build, conv, image

POINTS = SparsePoints(
    xy=torch.tensor([[3.0, 4.0], [10.0, 12.0], [15.0, 15.0], [7.0, 9.0], [0.0, 1.0]]),
    depth=torch.tensor([2.0, 3.0, 1.5, 4.0, 0.7]),
    size=(16, 16),
)
CUTS = {
    "unet": ("encoder.stages.0", "encoder[3]", "bottleneck", "ups.1"),
    "in place": ("a", "b", "relu", "c"),
    "midas": ("backbone.2", "backbone.3", "unit1", "unit2.relu#1", "unit1.conv1"),
    "branching": ("a", "cut"),
    "repeated": ("norm#1", "same#1", "same#2", "same#3", "enter"),
    "dataclass output": ("cut[deep]", "cut[shallow]"),
    "nested output": ("cut[out][1][x]", "cut.a"),
    "two branches": ("cut", "guide", "front.inner"),
    "side effects": ("cut", "one.conv", "enter"),
    "updating": ("enter", "cut"),
    "direct": ("part.a#1", "part.b#2", "head", "spectral.parametrizations.weight"),
    "scripted": ("cut",),
    "checkpointed": ("cut", "enter#1", "a"),
    "native": ("enter", "cut", "native"),
}


def refined(
    network: nn.Module,
    layer: str,
    settings: ClosedSettings,
    points: SparsePoints = POINTS,
    depth_of: Callable[[Any], Tensor] = lambda output: output,
) -> Refinement:
    with Split(network, layer) as split:
        return refine(split, (image(),), points, settings, depth_of=depth_of)


EVERY_CUT_AND_UPDATE = [
    *((name, layer, "adam") for name, layers in CUTS.items() for layer in layers),
    *(("unet", "bottleneck", update) for update in UPDATES if update != "adam"),
]


@pytest.mark.parametrize(("name", "layer", "update"), EVERY_CUT_AND_UPDATE)
def test_updates_are_those_of_running_the_whole_network(name: str, layer: str, update: str) -> None:
    network = build(name)
    settings = ClosedSettings(iterations=5, lr=0.02, update=update)
    depth, losses = naive_refine(network, layer, image(), POINTS, settings)
    result = refined(network, layer, settings)
    assert torch.equal(result.after, depth)
    assert list(result.losses) == losses
    assert not torch.equal(result.after, result.before)


@pytest.mark.parametrize(("name", "layer", "update"), EVERY_CUT_AND_UPDATE)
def test_the_depth_before_updates_is_the_plain_networks(name: str, layer: str, update: str) -> None:
    network = build(name)
    result = refined(network, layer, ClosedSettings(iterations=5, lr=0.02, update=update))
    assert torch.equal(result.before, plain(network, image()))


@pytest.mark.parametrize(("name", "layer", "update"), EVERY_CUT_AND_UPDATE)
def test_without_updates_the_depth_is_the_plain_networks_with_the_first_loss(
    name: str, layer: str, update: str
) -> None:
    network = build(name)
    settings = ClosedSettings(iterations=5, lr=0.02, update=update)
    first_loss = refined(network, layer, settings).losses[:1]
    none = refined(network, layer, replace(settings, iterations=0))
    assert torch.equal(none.after, plain(network, image()))
    assert none.before is none.after
    assert none.losses == first_loss


@pytest.mark.parametrize("update", UPDATES)
def test_pixels_that_no_point_reaches_keep_their_bits(update: str) -> None:
    torch.manual_seed(0)
    network = nn.Sequential(conv(3, 4), conv(4, 4), nn.ReLU(inplace=True), conv(4, 1))
    one = POINTS.select(torch.tensor([True, False, False, False, False]))  # at (3, 4)
    result = refined(network, "0", ClosedSettings(update=update, lr=0.1), points=one)
    changed = (result.after != result.before)[0, 0]
    assert bool(changed[4, 3])
    rows = changed.any(1).nonzero().flatten()
    columns = changed.any(0).nonzero().flatten()
    assert (int(rows.min()), int(rows.max())) == (0, 8)  # two 3×3 convolutions, there and back
    assert (int(columns.min()), int(columns.max())) == (0, 7)
    assert not changed[9:].any()
    assert not changed[:, 8:].any()


def test_a_linear_schedule_is_k_single_updates_with_falling_steps() -> None:
    double = Net(lambda net, x: net.cut(x[:, :1]) * 2, cut=nn.Identity())
    settings = ClosedSettings(iterations=4, lr=0.25, schedule="linear")
    points = replace(POINTS, depth=POINTS.depth + 50)
    result = refined(double, "cut", settings, points)
    moved = 2 * 0.25 * (1 + 0.75 + 0.5 + 0.25)
    assert torch.allclose(points.sample(result.after - result.before), torch.tensor(moved))


def breaking(n: int, bad: float) -> nn.Module:
    """Gives `bad` in the n-th pass behind the cut; 0 for never."""

    def run(net: Any, x: Tensor) -> Tensor:
        y = net.head(net.cut(x)).abs()
        return y * bad if net.head.calls == n else y

    return Net(run, cut=conv(3, 4), head=Counting(conv(4, 1)))


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
@pytest.mark.parametrize("iteration", [1, 5])
def test_a_loss_not_finite_stops_with_the_last_good_depth(iteration: int, bad: float) -> None:
    torch.manual_seed(0)
    with pytest.raises(DivergedError) as error:
        refined(breaking(iteration + 1, bad), "cut", ClosedSettings())
    assert error.value.exit_code == 5
    torch.manual_seed(0)
    good = refined(breaking(0, bad), "cut", ClosedSettings(iterations=iteration - 1))
    assert torch.equal(error.value.last_good.after, good.after)
    assert torch.equal(error.value.last_good.before, good.before)
    assert error.value.last_good.losses == good.losses


def test_a_gradient_that_is_not_finite_stops_with_the_depth_it_came_from() -> None:
    root = Net(lambda net, x: net.cut(x[:, :1] * 0).sqrt() + 1, cut=nn.Identity())
    with pytest.raises(DivergedError, match=r"gradient .* before any update") as error:
        refined(root, "cut", ClosedSettings(loss="l1"))
    assert torch.equal(error.value.last_good.after, torch.ones(1, 1, 16, 16))
    assert len(error.value.last_good.losses) == 1


SCALE = torch.ones(1, requires_grad=True)


@pytest.mark.parametrize(
    "behind",
    [
        lambda net, z, x: net.head(net.side(x)),
        lambda net, z, x: net.head(z.detach() + net.side(x)),
        lambda net, z, x: net.head(net.side(x)) * SCALE,  # another gradient
        torch.no_grad()(lambda net, z, x: net.head(z)),
        torch.inference_mode()(lambda net, z, x: net.head(z)),
        lambda net, z, x: net.head(z) * torch.nan,
        lambda net, z, x: net.head(z).abs() * torch.inf,
    ],
)
def test_no_gradient_or_no_finite_prediction_is_refused(behind: Callable[..., Tensor]) -> None:
    parts = {"cut": conv(3, 4), "side": conv(3, 4), "head": conv(4, 1)}
    network = Net(lambda net, x: behind(net, net.cut(x), x), **parts)
    with pytest.raises(ModelError) as error:
        refined(network, "cut", ClosedSettings())
    assert error.value.exit_code == 4
    assert "\n" not in str(error.value)


def in_low_precision(dtype: torch.dtype) -> nn.Module:
    """Two convolutions with a tanh between, in `dtype` from end to end."""
    torch.manual_seed(0)
    parts = {"encode": conv(3, 4), "decode": conv(4, 1)}
    run = Net(lambda net, x: 2 + net.decode(torch.tanh(net.encode(x.to(dtype)))), **parts)
    return run.to(dtype)


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_z_is_float32_and_the_rear_of_it_is_the_network_bit_for_bit(dtype: torch.dtype) -> None:
    network = in_low_precision(dtype)
    with torch.no_grad(), Split(network, "encode") as split:
        z = split.front(image())
        output = split.rear(z)
        assert (z.dtype, output.dtype) == (torch.float32, dtype)
        assert torch.equal(output, network(image()))


@pytest.mark.parametrize(
    ("dtype", "per_unit", "settings"),
    [
        # A step of 2^-12 is nothing to a bfloat16 near 1; many of them together are not.
        (torch.bfloat16, 1.0, ClosedSettings(iterations=200, lr=2.0**-10)),
        # A tenth of a micrometre per unit: ∂L/∂output is below the smallest float16.
        (torch.float16, 1e-7, ClosedSettings(iterations=1, lr=1.0)),
    ],
)
def test_in_low_precision_small_steps_add_up_and_small_gradients_move_z(
    dtype: torch.dtype, per_unit: float, settings: ClosedSettings
) -> None:
    network = in_low_precision(dtype)
    result = refined(network, "encode", settings, depth_of=lambda out: per_unit * out.float())
    assert not torch.equal(result.before, result.after)
    assert dtype == torch.float16 or result.losses[-1] < 0.9 * result.losses[0]
