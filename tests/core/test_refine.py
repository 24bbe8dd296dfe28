"""Equations 2 and 3, against a refinement that runs the whole network every time."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor, nn

from pnpdepth_cli.choices import UPDATES
from pnpdepth_cli.core.refine import Refinement, refine
from pnpdepth_cli.core.split import Split
from pnpdepth_cli.errors import (
    DivergedError,
    LayerError,
    ModelError,
)
from pnpdepth_cli.points import SparsePoints
from pnpdepth_cli.settings import ClosedSettings
from tests.completion.naive import naive_refine, plain
from tests.core.networks import build, conv, depth_of, image

POINTS = SparsePoints(
    xy=torch.tensor([[3.0, 4.0], [10.0, 12.0], [15.0, 15.0], [7.0, 9.0], [0.0, 1.0]]),
    depth=torch.tensor([2.0, 3.0, 1.5, 4.0, 0.7]),
    size=(16, 16),
)
CUTS = {
    "unet": ("encoder.stages.0", "encoder[3]", "bottleneck", "ups.1"),
    "vit": ("encoder[last]", "encoder[hidden][1]", "encoder.blocks.1[0]", "encoder.norm"),
    "in place": ("a", "b", "relu", "c"),
    "midas": ("backbone.2", "backbone.3", "unit1", "unit2.relu#1", "unit1.conv1"),
    "branching": ("a", "cut"),
    "repeated": ("norm#1", "same#1", "same#2", "same#3", "enter"),
    "tuple output": ("cut[0]", "cut.a"),
    "dict output": ("cut[deep]", "cut[shallow]"),
    "dataclass output": ("cut[shallow]",),
    "nested output": ("cut[out][1][x]",),
    "two branches": ("cut", "guide", "front.inner"),
    "side effects": ("cut", "one.conv", "enter"),
    "updating": ("enter", "cut"),
    "direct": ("methods.a#1", "methods.b", "head", "spectral.parametrizations.weight"),
    "scripted": ("cut",),
    "checkpointed": ("cut", "enter#1", "a"),
    "native": ("enter", "cut", "native"),
    "wrapped": ("module.0.0", "module.0", "module.1.a"),
}


def refined(
    network: nn.Module, layer: str, settings: ClosedSettings, points: SparsePoints = POINTS
) -> Refinement:
    with Split(network, layer) as split:
        return refine(split, (image(),), points, settings, depth_of=depth_of)


@pytest.mark.parametrize(
    ("name", "layer", "update"),
    [
        *((name, layer, "adam") for name, layers in CUTS.items() for layer in layers),
        *(("unet", "bottleneck", update) for update in UPDATES if update != "adam"),
    ],
)
def test_five_updates_are_those_of_running_the_whole_network_every_time(
    name: str, layer: str, update: str
) -> None:
    network = build(name)
    settings = ClosedSettings(iterations=5, lr=0.02, update=update)
    depth, losses = naive_refine(network, layer, image(), POINTS, settings, depth_of)
    result = refined(network, layer, settings)
    assert torch.equal(result.after, depth)
    assert list(result.losses) == losses
    assert not torch.equal(result.after, result.before)
    whole = depth_of(plain(network, image()))
    if name == "vit":  # torch's attention takes another kernel where no gradient is wanted
        torch.testing.assert_close(result.before, whole)
    else:
        assert torch.equal(result.before, whole)
    none = refined(network, layer, replace(settings, iterations=0))
    assert torch.equal(none.after, whole)
    assert none.before is none.after
    assert none.losses == result.losses[:1] or name == "vit"


@pytest.mark.parametrize("update", UPDATES)
def test_pixels_that_no_point_reaches_keep_their_bits(update: str) -> None:
    torch.manual_seed(0)
    network = nn.Sequential(conv(3, 4), conv(4, 4), nn.ReLU(inplace=True), conv(4, 1))
    one = POINTS.select(torch.tensor([True, False, False, False, False]))  # at (3, 4)
    result = refined(network, "0", ClosedSettings(update=update, lr=0.1), points=one)
    changed = (result.after != result.before)[0, 0]
    assert bool(changed[4, 3])
    rows, columns = changed.any(1).nonzero().flatten(), changed.any(0).nonzero().flatten()
    assert (int(rows.min()), int(rows.max())) == (0, 8)  # two 3×3 convolutions, there and back
    assert (int(columns.min()), int(columns.max())) == (0, 7)
    assert not changed[9:].any()
    assert not changed[:, 8:].any()


def doubled(pixels: int, depth: list[float], settings: ClosedSettings) -> Refinement:
    """`Doubling` refined in a row of pixels with a point on each, from depth 6 everywhere."""
    xy = torch.stack([torch.arange(float(pixels)), torch.zeros(pixels)], dim=1)
    points = SparsePoints(xy=xy, depth=torch.tensor(depth), size=(1, pixels))
    with Split(Doubling(), "cut") as split:
        x = (torch.full((1, 3, 1, pixels), 3.0),)
        return refine(split, x, points, settings, depth_of=lambda y: y)


# ------------------------------------------------------------------ the step size


def test_a_linear_schedule_is_k_single_updates_with_falling_steps() -> None:
    settings = ClosedSettings(iterations=4, lr=0.25, schedule="linear")
    moved = 2 * 0.25 * (1 + 0.75 + 0.5 + 0.25)
    assert doubled(2, [50.0, 90.0], settings).after.flatten().tolist() == [6 + moved, 6 + moved]


# ------------------------------------------------------------------ the best iterate


class Doubling(nn.Module):
    """depth = 2·z, z the first channel of the image."""

    def __init__(self) -> None:
        super().__init__()
        self.cut = nn.Identity()

    def forward(self, x: Tensor) -> Tensor:
        return self.cut(x[:, :1]) * 2


# ------------------------------------------------------------------ divergence


class Breaking(nn.Module):
    """Gives `bad` in the n-th pass behind the cut."""

    def __init__(self, n: int, bad: float):
        super().__init__()
        self.cut, self.head = conv(3, 4), conv(4, 1)
        self.n, self.bad, self.passes = n, bad, 0

    def forward(self, x: Tensor) -> Tensor:
        y = self.head(self.cut(x)).abs()
        self.passes += 1
        return y * self.bad if self.passes == self.n else y


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
@pytest.mark.parametrize("iteration", [1, 5])
def test_a_loss_that_is_not_finite_stops_with_the_last_good_depth(
    iteration: int, bad: float
) -> None:
    torch.manual_seed(0)
    network = Breaking(iteration + 1, bad)
    with pytest.raises(DivergedError) as error:
        refined(network, "cut", ClosedSettings())
    assert error.value.exit_code == 5
    network.n = 0
    good = refined(network, "cut", ClosedSettings(iterations=iteration - 1))
    assert torch.equal(error.value.last_good.after, good.after)
    assert torch.equal(error.value.last_good.before, good.before)
    assert error.value.last_good.losses == good.losses


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_a_prediction_that_is_not_finite_to_begin_with_is_the_networks_fault(bad: float) -> None:
    with pytest.raises(ModelError) as error:
        refined(Breaking(1, bad), "cut", ClosedSettings())
    assert f"at any of {len(POINTS)} sparse points" in str(error.value)
    assert error.value.exit_code == 4
    assert "\n" not in str(error.value)


def test_a_gradient_that_is_not_finite_stops_with_the_depth_it_came_from() -> None:
    class Root(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.cut = nn.Identity()

        def forward(self, x: Tensor) -> Tensor:
            return self.cut(x[:, :1] * 0).sqrt() + 1

    with pytest.raises(DivergedError) as error:
        refined(Root(), "cut", ClosedSettings(loss="l1"))
    assert torch.equal(error.value.last_good.after, torch.ones(1, 1, 16, 16))
    assert len(error.value.last_good.losses) == 1


# ------------------------------------------------------------------ no gradient to z


class NoWayBack(nn.Module):
    def __init__(self, how: str):
        super().__init__()
        self.cut, self.side, self.head, self.how = conv(3, 4), conv(3, 4), conv(4, 1), how

    def forward(self, x: Tensor) -> Tensor:
        z, side = self.cut(x), self.side(x)
        if self.how == "unused":
            z = side
        elif self.how == "detach":
            z = z.detach() + side
        elif self.how == "no_grad":
            with torch.no_grad():
                return self.head(z)
        elif self.how == "inference_mode":
            with torch.inference_mode():
                return self.head(z)
        return self.head(z)


def without_gradients() -> nn.Module:
    network = NoWayBack("")
    network.forward = torch.no_grad()(network.forward)  # type: ignore[method-assign]
    return network


def with_another_gradient() -> nn.Module:
    network, scale = NoWayBack("unused"), torch.ones(1, requires_grad=True)
    network.head.register_forward_hook(lambda module, inputs, output: output * scale)
    return network


@pytest.mark.parametrize(
    "network",
    [
        *map(NoWayBack, ("unused", "detach", "no_grad", "inference_mode")),
        with_another_gradient(),
        without_gradients(),
    ],
)
def test_a_layer_without_a_gradient_back_to_it_is_refused_on_one_line(network: nn.Module) -> None:
    with pytest.raises(LayerError) as error:
        refined(network, "cut", ClosedSettings())
    assert error.value.exit_code == 4
    assert "\n" not in str(error.value)
