"""Small depth networks, each with one thing that makes cutting hard."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint


class Net(nn.Module):
    """Named parts, and a function that is called with the network and its inputs."""

    def __init__(self, run: Callable[..., Any], **parts: nn.Module) -> None:
        super().__init__()
        self.run = run
        for name, module in parts.items():
            self.add_module(name, module)

    def forward(self, *args: Any, **kwargs: Any) -> Any:
        return self.run(self, *args, **kwargs)


def conv(channels: int, out: int, kernel: int = 3, stride: int = 1) -> nn.Conv2d:
    return nn.Conv2d(channels, out, kernel, stride, padding=kernel // 2)


class UNet(nn.Module):
    """Takes its skips off the encoder's list with pop(), and works on them in place.

    The encoder's list starts with the input image itself.
    """

    def __init__(self) -> None:
        super().__init__()
        stages = (
            nn.Sequential(conv(a, b, stride=2), nn.ReLU(inplace=True))
            for a, b in ((3, 4), (4, 8), (8, 8))
        )
        self.encoder = Net(self.encode, stages=nn.ModuleList(stages))
        self.bottleneck = conv(8, 8)
        self.ups = nn.ModuleList((conv(16, 8), conv(12, 4), conv(7, 1)))

    @staticmethod
    def encode(encoder: Any, x: Tensor) -> list[Tensor]:
        features = [x]
        for stage in encoder.stages:
            features.append(stage(features[-1]))
        return features

    def forward(self, x: Tensor) -> Tensor:
        skips = self.encoder(x)
        x = self.bottleneck(skips.pop())
        for up in self.ups:
            skip = skips.pop()
            skip = skip + 0.5 if skip.requires_grad else skip.add_(0.5)
            x = up(torch.cat([F.interpolate(F.relu(x), scale_factor=2.0), skip], 1))
        return x.abs() + 1


def in_place() -> nn.Module:
    """In-place operations on recorded outputs, right behind the cut and on the input."""

    def run(net: Any, x: Tensor) -> Tensor:
        x -= 0.5
        a = net.a(x)
        first = net.relu(a)  # the same tensor as a
        b = net.b(first)
        F.relu_(b)
        b = b + a if b.requires_grad else b.add_(a)
        a = a * 1.5 if a.requires_grad else a.mul_(1.5)
        flat = net.flat(b)
        flat.add_(0.25)  # changes b too
        c = net.c(b)
        c = c + 1 if c.requires_grad else torch.add(c, 1, out=c)
        c += x.mean()
        return net.d(c + a).abs_().add_(1)

    parts = {"a": conv(3, 4), "b": conv(4, 4), "c": conv(4, 4), "d": conv(4, 1)}
    return Net(run, relu=nn.ReLU(inplace=True), flat=nn.Flatten(2), **parts)


def midas() -> nn.Module:
    """Forward hooks store features, which the network clears and reads; as in MiDaS.

    In its residual units the in-place ReLU changes x itself, which is then added.
    """
    features: list[Tensor] = []

    def residual(unit: Any, x: Tensor) -> Tensor:
        out = unit.conv1(unit.relu(x))
        return unit.conv2(unit.relu(out)) + x

    def run(net: Any, x: Tensor) -> Tensor:
        features.clear()
        deep = net.backbone(x)
        first, second = features
        y = net.unit1(first * 0.5) + second
        return net.head(net.unit2(y + deep)).abs() + 1

    backbone = nn.Sequential(conv(3, 4), nn.ReLU(inplace=True), conv(4, 4), conv(4, 4))
    for index in (0, 2):
        backbone[index].register_forward_hook(lambda module, inputs, out: features.append(out))
    one, two = (
        Net(residual, conv1=conv(4, 4), conv2=conv(4, 4), relu=nn.ReLU(inplace=True))
        for _ in range(2)
    )
    return Net(run, backbone=backbone, unit1=one, unit2=two, head=conv(4, 1))


def branching(escape: Callable[[Tensor], bool] = lambda y: bool(y.mean() > 0.3)) -> nn.Module:
    """Python branches on values, before the cut and behind it."""

    def run(net: Any, x: Tensor) -> Tensor:
        a = net.a(x)
        if a.mean() > 0:
            a = -a
        y = net.cut(a)
        if escape(y.detach()):
            y = y + net.side(a)
        else:
            a = F.relu(a) if a.requires_grad else net.relu(a)
            y = y - net.side(y) + a
        return net.head(y).abs() + 1

    parts = {"a": conv(3, 4), "cut": conv(4, 4), "side": conv(4, 4), "head": conv(4, 1)}
    return Net(run, relu=nn.ReLU(inplace=True), **parts)


def repeated() -> nn.Module:
    """One submodule before the cut, at it, and behind it; shared weights under two names."""

    def run(net: Any, x: Tensor) -> Tensor:
        x = net.norm(net.enter(x))
        x = net.norm(net.same(x))
        x = net.same(x).relu_()
        x = x + net.norm(net.same(x)) + net.tied(x)
        return net.head(x).abs() + 1

    enter = conv(3, 4)
    same = conv(4, 4)
    tied = conv(4, 4)
    tied.weight = same.weight
    parts = {"norm": nn.BatchNorm2d(4), "head": conv(4, 1), "tied": tied}
    return Net(run, enter=enter, same=same, alias=enter, **parts)


@dataclass(frozen=True)
class Frozen:
    deep: Tensor
    shallow: Tensor
    scale: float = 2.0


MAKES: dict[str, Callable[[Tensor, Tensor], Any]] = {
    "dataclass": Frozen,
    "nested": lambda a, b: {"out": [(a, 3), {"x": b}], 5: "text"},
}


def structured(kind: str) -> nn.Module:
    """The cut layer returns a structure; the network changes the rest of it in place."""

    def run(net: Any, x: Tensor) -> Tensor:
        out = net.cut(net.enter(x))
        if kind == "nested":
            deep, shallow = out["out"][0][0], out["out"][1]["x"]
            out["out"].pop()
        else:
            deep, shallow = out.deep, out.shallow
        shallow += 1
        shallow.relu_()
        return net.head(deep * shallow).abs() + 1

    cut = Net(lambda part, x: MAKES[kind](part.a(x), part.b(x)), a=conv(4, 4), b=conv(4, 4))
    return Net(run, enter=conv(3, 4), cut=cut, head=conv(4, 1))


class Counting(nn.Module):
    """A layer that counts its calls in `calls`."""

    def __init__(self, inner: nn.Module):
        super().__init__()
        self.inner = inner
        self.calls = 0

    def forward(self, *args: Any, **kwargs: Any) -> Any:
        self.calls += 1
        return self.inner(*args, **kwargs)


def two_branches() -> nn.Module:
    """Behind the cut, one branch looks at the image only, one at z only through argmax."""

    def chosen(part: Any, z: Tensor) -> Tensor:
        return part.branch((torch.arange(4)[:, None, None] == z.argmax(1, keepdim=True)).float())

    def run(net: Any, x: Tensor) -> Tensor:
        z = net.cut(net.front(x))
        guide = net.guide(x)
        guide += 0.1
        return net.head(z * guide + net.detached(z)).abs() + 1

    return Net(
        run,
        front=Counting(conv(3, 4)),
        cut=conv(4, 4),
        guide=Counting(nn.Sequential(conv(3, 4), nn.ReLU(inplace=True), conv(4, 4))),
        detached=Counting(Net(chosen, branch=conv(4, 4))),
        head=Counting(conv(4, 1)),
    )


def side_effects() -> nn.Module:
    """Parts that give features to a list they are handed; one that hides tensors."""

    def append(part: Any, x: Tensor, into: list[Tensor]) -> Tensor:
        into.append(part.conv(x))
        return x

    def run(net: Any, x: Tensor) -> Tensor:
        tensors: list[Tensor] = []
        x = net.two(net.one(net.enter(x), tensors), into=tensors)
        hidden = net.hide(x)
        hidden.tensor += 1
        z = net.cut(x) + hidden.tensor
        return net.head(z * tensors[0] + tensors[1]).abs() + 1

    one, two = (Net(append, conv=conv(4, 4)) for _ in range(2))
    hide = Net(lambda part, x: SimpleNamespace(tensor=part.conv(x)), conv=conv(4, 4))
    return Net(run, enter=conv(3, 4), one=one, two=two, cut=conv(4, 4), hide=hide, head=conv(4, 1))


class Updating(nn.Module):
    """Buffers and a parameter that every forward changes, in place and by assignment."""

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("passes", torch.zeros(()))
        self.register_buffer("average", torch.zeros(1, 4, 1, 1))
        self.enter = conv(3, 4)
        self.cut = conv(4, 4)
        self.head = conv(4, 1)

    def forward(self, x: Tensor) -> Tensor:
        self.passes += 1
        with torch.no_grad():
            self.cut.weight.clamp_(min=0)
        y = self.enter(x)
        self.average = 0.5 * self.average + 0.5 * y.mean((2, 3), keepdim=True)
        return self.head(self.cut(y * self.passes) + self.average).abs() + 1


def direct() -> nn.Module:
    """Calls forward() itself, a method of a submodule, and parametrizations."""

    def run(net: Any, x: Tensor) -> Tensor:
        x = net.spectral.forward(net.enter.forward(x))
        x = net.part.run(net.part, x) + net.part(x=x)
        return net.head(x).abs() + 1

    enter = nn.utils.parametrizations.weight_norm(conv(3, 4))
    spectral = nn.utils.parametrizations.spectral_norm(conv(4, 4))
    part = Net(lambda part, x: part.b(part.a(x)), a=conv(4, 4), b=conv(4, 4))
    return Net(run, enter=enter, spectral=spectral, part=part, head=conv(4, 1))


def scripted() -> nn.Module:
    return Net(
        lambda net, x: net.frozen(net.tail(net.cut(net.enter(x)))).abs() + 1,
        enter=torch.jit.script(nn.Sequential(conv(3, 4), nn.ReLU())),
        cut=conv(4, 4),
        tail=torch.jit.script(conv(4, 4)),
        frozen=torch.jit.freeze(torch.jit.script(conv(4, 1).eval())),
    )


def checkpointed() -> nn.Module:
    """The part behind the cut runs again in the backward pass."""

    def run(net: Any, x: Tensor) -> Tensor:
        def block(y: Tensor, x: Tensor) -> Tensor:
            return net.b(torch.sigmoid(net.a(y)) * net.enter(x)).sin()

        y = net.cut(net.enter(x))
        return net.head(checkpoint(block, y, x, use_reentrant=False)).abs() + 1

    parts = {"enter": conv(3, 4), "cut": conv(4, 4), "a": conv(4, 4), "b": conv(4, 4)}
    return Net(run, head=conv(4, 1), **parts)


def half_inference() -> nn.Module:
    """An encoder under inference_mode, a decoder outside it."""

    def run(net: Any, x: Tensor) -> Tensor:
        x = net.enter(x)
        return net.head(net.cut(x) * x).abs() + 1

    enter = Net(torch.inference_mode()(lambda part, x: part.inner(x)), inner=conv(3, 4))
    return Net(run, enter=enter, cut=conv(4, 4), head=conv(4, 1))


class NativeFunction(torch.autograd.Function):
    """As an extension in C++ does it: the values get over without a tensor operation."""

    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        out = torch.empty(x.shape)
        with torch._C.DisableTorchFunction(), torch.utils._python_dispatch._disable_current_modes():
            out.copy_(x.detach() * 2)
        return out

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:
        return gradient * 2


def native() -> nn.Module:
    """An operator from outside torch whose reading of z no dispatcher sees."""
    return Net(
        lambda net, x: net.head(net.after(net.native(net.cut(net.enter(x))))).abs() + 1,
        enter=conv(3, 4),
        cut=conv(4, 4),
        native=Net(lambda part, x: NativeFunction.apply(x)),
        after=conv(4, 4),
        head=conv(4, 1),
    )


def catches() -> nn.Module:
    """A part that takes another way after any exception, in a part that does so too."""

    def run_inner(part: Any, x: Tensor) -> Tensor:
        try:
            return part.cut(x).relu()
        except Exception:
            return part.other(x)

    def run(net: Any, x: Tensor) -> Tensor:
        x = net.enter(x)
        try:
            x = net.inner(x)
        except Exception:
            x = -x
        return net.head(net.plain(x) + x).abs() + 1

    inner = Net(run_inner, cut=conv(4, 4), other=conv(4, 4, 1))
    plain = nn.Sequential(conv(4, 4))
    return Net(run, enter=conv(3, 4), inner=inner, plain=plain, head=conv(4, 1))


NETWORKS: dict[str, Callable[[], nn.Module]] = {
    "unet": UNet,
    "in place": in_place,
    "midas": midas,
    "branching": branching,
    "repeated": repeated,
    **{f"{kind} output": functools.partial(structured, kind) for kind in MAKES},
    "two branches": two_branches,
    "side effects": side_effects,
    "updating": Updating,
    "direct": direct,
    "scripted": scripted,
    "checkpointed": checkpointed,
    "half inference": half_inference,
    "native": native,
    "catches": catches,
}


def build(name: str) -> nn.Module:
    """The network of that name with fixed random weights, batch norms with statistics, training."""
    torch.manual_seed(0)
    network = NETWORKS[name]()
    for module in network.modules():
        if isinstance(module, nn.BatchNorm2d):
            nn.init.uniform_(module.running_mean, -0.5, 0.5)
            nn.init.uniform_(module.running_var, 0.5, 1.5)
    return network.train()


def image(height: int = 16, width: int = 16) -> Tensor:
    return torch.rand(1, 3, height, width, generator=torch.Generator().manual_seed(1))


def state_of(network: nn.Module) -> dict[str, Any]:
    """Everything of a network that a split could leave changed."""
    state: dict[str, Any] = {}
    for name, module in network.named_modules():
        state[name] = (
            module.training,
            module.__dict__.get("forward"),
            sorted(module.__dict__),
            *(list(getattr(module, hooks)) for hooks in vars(nn.Module()) if "hooks" in hooks),
        )
    for name, tensor in (*network.named_parameters(), *network.named_buffers()):
        grad = None if tensor.grad is None else bits(tensor.grad)
        state[f"tensor {name}"] = (id(tensor), bits(tensor), tensor.requires_grad, grad)
    return state


def bits(tensor: Tensor) -> bytes:
    return tensor.detach().numpy().tobytes()
