"""rear(front(x)) is f(x), at every layer of every kind of network, and leaves no trace."""

from __future__ import annotations

import copy
import gc
import weakref
from collections.abc import Callable
from typing import Any
from unittest.mock import Mock

import pytest
import torch
from torch import Tensor, nn

from pnpdepth_cli.core.split import Split
from pnpdepth_cli.errors import ModelError
from tests.completion.naive import plain
from tests.core.networks import NETWORKS, Counting, Net, UNet, build, conv, image, state_of

NO_CUT = {
    "unet": {"encoder.stages", "ups"},
    "in place": {"flat"},
    "side effects": {"hide"},
    "catches": {"inner.other"},
    "direct": {"enter.parametrizations", "spectral.parametrizations"},
    "scripted": {"enter.0", "enter.1"},
}
"""Layers that give no tensor or never run, and one whose cut would not be a cut (`torn`)."""


@pytest.mark.parametrize("name", NETWORKS)
def test_the_rear_of_the_front_is_the_network_bit_for_bit_at_every_layer(name: str) -> None:
    network = build(name)
    x = image()
    frames = [x, x.flip(3) * 0.7, x]
    wholes = [plain(network, frame) for frame in frames]
    layers = [layer for layer, _ in network.named_modules(remove_duplicate=False) if layer]
    can = 0
    cannot = set()
    while layers:
        layer = layers.pop(0)
        try:
            with Split(network, layer) as split, torch.no_grad():
                for frame, whole in zip(frames, wholes, strict=True):
                    z = split.front(frame)
                    for _ in range(3):
                        assert torch.equal(split.rear(z), whole), layer
            can += 1
        except ModelError as error:
            said = str(error)
            assert "\n" not in said
            if "say which" in said:
                layers += said.split(": ")[-1].split(", ")
            else:
                cannot.add(layer)
    assert cannot == NO_CUT.get(name, set())
    assert can > 1
    assert torch.equal(plain(network, x), wholes[0])


def test_torch_transformer_layers_with_their_fast_path_come_out_the_same() -> None:
    torch.manual_seed(0)
    layer = nn.TransformerEncoderLayer(8, 2, 16, batch_first=True)
    network = nn.Sequential(nn.Linear(4, 8), nn.TransformerEncoder(layer, 2), nn.Linear(8, 1))
    frames = [torch.rand(1, 6, 4) * scale for scale in (1, 3, 1)]
    wholes = [plain(network, frame) for frame in frames]
    for name in ("0", "1", "1.layers.0", "1.layers.1"):
        with Split(network, name) as split, torch.no_grad():
            for frame, whole in zip(frames, wholes, strict=True):
                assert torch.equal(split.rear(split.front(frame)), whole)
            assert split.static_graph


def choosing_by_value() -> nn.Module:
    """In front of the cut, one of two branches; the second changes what the first only reads."""

    def run(net: Any, x: Tensor) -> Tensor:
        y = net.enter(x)
        features = net.one(y) if bool(x.mean() > 0.4) else net.relu(y)
        return net.head(torch.cat([net.cut(features), y], 1))

    parts = {"enter": conv(3, 4), "one": conv(4, 4), "cut": conv(4, 4), "head": conv(8, 1)}
    return Net(run, relu=nn.ReLU(inplace=True), **parts)


@pytest.mark.parametrize(
    ("make", "layer", "frames"),
    [
        (choosing_by_value, "cut", [image(), image() * 0.5, image(), image() * 0.5]),
        (UNet, "bottleneck", [image(), image(32, 16), image() * 0.5]),
    ],
    ids=["chooses by value", "another size"],
)
def test_a_frame_that_needs_another_recording_is_learned_anew(
    make: Callable[[], nn.Module], layer: str, frames: list[Tensor]
) -> None:
    torch.manual_seed(0)
    network = make()
    wholes = [plain(network, frame) for frame in frames]
    with Split(network, layer) as split, torch.no_grad():
        for frame, whole in zip(frames, wholes, strict=True):
            z = split.front(frame)
            for _ in range(2):
                assert torch.equal(split.rear(z), whole)


def test_the_network_may_be_called_for_itself_while_it_is_cut() -> None:
    network = build("repeated")
    x = image()
    other = image() * 0.5
    whole = plain(network, x)
    other_whole = plain(network, other)
    with Split(network, "head") as split, torch.no_grad():
        z = split.front(x)
        assert torch.equal(network(other), other_whole)
        assert torch.equal(split.rear(z), whole)
        assert torch.equal(network(other), other_whole)
        assert torch.equal(split.rear(z), whole)


def test_the_front_runs_once_and_what_does_not_depend_on_z_twice_at_most() -> None:
    network = build("two branches")
    x = image()
    with Split(network, "cut") as split, torch.no_grad():
        z = split.front(x)
        assert (network.front.calls, network.guide.calls) == (1, 0)
        for k in range(5):
            split.rear(z + k)
    assert network.front.calls == 1
    assert network.guide.calls == 1
    assert network.detached.calls == 5  # looks at z through argmax only
    assert network.head.calls == 5


def test_nothing_of_an_image_stays_in_memory_after_the_split_closes() -> None:
    network = build("unet")
    x = image()
    seen: list[weakref.ref[Tensor]] = []
    hook = network.bottleneck.register_forward_hook(
        lambda module, inputs, output: seen.extend((weakref.ref(inputs[0]), weakref.ref(output)))
    )
    split = Split(network, "ups.0")
    with split:
        z = split.front(x).requires_grad_(True)
        split.rear(z).sum().backward()
        split.rear(z.detach())
        seen.append(weakref.ref(z))
    del z
    hook.remove()
    gc.collect()
    assert len(seen) == 9  # the front ran twice: this encoder cannot be remembered as a whole
    assert [reference() for reference in seen] == [None] * 9
    del split


@pytest.mark.parametrize(
    ("make", "layer"),
    [
        (UNet, "botleneck"),
        (UNet, "zzzzzzzzz"),
        (UNet, ""),
        (UNet, "ups.3"),
        (UNet, "bottleneck["),
        (lambda: Net(lambda net, x: net.head(x), head=conv(3, 1), unused=conv(1, 1)), "unused"),
        (NETWORKS["repeated"], "same#4"),
        (NETWORKS["nested output"], "cut[wide]"),
    ],
)
def test_what_is_no_cut_is_refused_on_one_line(make: Callable[[], nn.Module], layer: str) -> None:
    network = make()
    with pytest.raises(ModelError) as error, torch.no_grad(), Split(network, layer) as split:
        split.rear(split.front(image()))
    assert "\n" not in str(error.value)


def test_the_rear_needs_a_front_that_succeeded_and_may_be_tried_again() -> None:
    network = build("unet")
    x = image()
    with Split(network, "bottleneck") as split, torch.no_grad():
        for _ in range(2):
            with pytest.raises(RuntimeError, match="front"):
                split.rear(torch.zeros(1))
            with pytest.raises(ModelError):
                split.front(torch.zeros(1, 7, 4, 4))
        z = split.front(x)
        with pytest.raises(ModelError):
            split.rear(z[:, :3])
        assert torch.equal(split.rear(z), plain(network, x))


def prepared(name: str) -> nn.Module:
    """A network with mixed modes and flags, a gradient, a hook, and a forward of its own."""
    network = build(name)
    parts = list(network.modules())
    parts[-1].eval()
    parameters = list(network.parameters())
    parameters[0].requires_grad_(False)
    parameters[-1].grad = torch.ones_like(parameters[-1])
    parts[1].register_forward_pre_hook(lambda module, inputs: None)
    parts[-1].forward = parts[-1].forward  # type: ignore[method-assign]
    return network


LAYERS = {
    "unet": "bottleneck",
    "midas": "unit1.conv1",
    "updating": "cut",
    "repeated": "same#2",
    "branching": "cut",
}


@pytest.mark.parametrize("name", LAYERS)
def test_the_network_is_as_before_when_the_split_closes(name: str) -> None:
    network = prepared(name)
    x = image()
    before = state_of(network)
    with Split(network, LAYERS[name]) as split:
        z = split.front(x)
        assert not z.requires_grad
        split.rear(z.requires_grad_(True)).sum().backward()
        split.rear(z.detach() + 1)
        assert before != state_of(network)
    assert before == state_of(network)


def use(split: Split, kind: type[BaseException]) -> None:
    z = split.front(image())
    split.rear(z)
    split.rear(z)
    raise kind("inside")


@pytest.mark.parametrize("stage", ["front", "first rear", "second rear", "inside", "entering"])
@pytest.mark.parametrize("kind", [RuntimeError, KeyboardInterrupt])
def test_the_network_is_as_before_after_exceptions(stage: str, kind: type[BaseException]) -> None:
    network = prepared("updating")
    network.enter = failing(network.enter, 1 if stage == "front" else 0, kind)
    network.head = failing(network.head, {"first rear": 1, "second rear": 2}.get(stage, 0), kind)
    if stage == "entering":
        network.cut.train = Mock(side_effect=kind("entering"))
    before = state_of(network)
    in_network = stage not in ("inside", "entering")
    wanted = ModelError if in_network and kind is RuntimeError else kind
    with pytest.raises(wanted), Split(network, "cut") as split:
        use(split, kind)
    assert before == state_of(network)


def failing(inner: nn.Module, n: int, kind: type[BaseException]) -> nn.Module:
    """Raises in its n-th call; 0 for never."""
    counted = Counting(inner)

    def run(net: Any, x: Tensor) -> Tensor:
        y = counted(x)
        if counted.calls == n:
            raise kind("failing")
        return y

    return Net(run, counted=counted)


class HooksItself(nn.Module):
    """Sets a hook in its first pass, which takes features of its encoder, as transformers do."""

    def __init__(self) -> None:
        super().__init__()
        self.encoder = nn.Sequential(conv(3, 4), conv(4, 4))
        self.neck = conv(4, 4)
        self.head = conv(8, 1)
        self.features: list[torch.Tensor] = []
        self.has_hooks = False

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        if not self.has_hooks:
            self.has_hooks = True
            self.encoder[0].register_forward_hook(lambda _part, _in, y: self.features.append(y))
        self.features.clear()
        x = self.neck(self.encoder(x))
        return self.head(torch.cat([x, *self.features], dim=1))


def test_hooks_that_a_network_sets_in_its_first_pass_run_in_every_pass() -> None:
    torch.manual_seed(0)
    network = HooksItself().eval()
    expected = plain(copy.deepcopy(network), image(16, 16))
    with Split(network, "neck") as split, torch.no_grad():
        assert torch.equal(split.rear(split.front(image(16, 16))), expected)
