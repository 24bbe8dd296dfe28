"""Small depth networks, each with one thing that makes cutting hard."""

from __future__ import annotations

import functools
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint


def conv(channels: int, out: int, kernel: int = 3, stride: int = 1) -> nn.Conv2d:
    return nn.Conv2d(channels, out, kernel, stride, padding=kernel // 2)


# ------------------------------------------------------------------ ordinary architectures


class SkipEncoder(nn.Module):
    """Returns a list that starts with the input image itself."""

    def __init__(self) -> None:
        super().__init__()
        self.stages = nn.ModuleList(
            nn.Sequential(conv(a, b, stride=2), nn.ReLU(inplace=True))
            for a, b in ((3, 4), (4, 8), (8, 8))
        )

    def forward(self, x: Tensor) -> list[Tensor]:
        features = [x]
        for stage in self.stages:
            features.append(stage(features[-1]))
        return features


class UNet(nn.Module):
    """Takes its skips off the encoder's list with pop(), and works on them in place."""

    def __init__(self) -> None:
        super().__init__()
        self.encoder = SkipEncoder()
        self.bottleneck = conv(8, 8)
        self.ups = nn.ModuleList((conv(16, 8), conv(12, 4), conv(7, 1)))

    def forward(self, x: Tensor) -> Tensor:
        skips = self.encoder(x)
        x = self.bottleneck(skips.pop())
        for up in self.ups:
            skip = skips.pop()
            skip = skip + 0.5 if skip.requires_grad else skip.add_(0.5)
            x = up(torch.cat([F.interpolate(F.relu(x), scale_factor=2.0), skip], 1))
        return x.abs() + 1


@dataclass
class Encoded(OrderedDict):  # type: ignore[type-arg]
    """Keys and attributes at once, as Hugging Face's outputs."""

    last: Any = None
    hidden: Any = None

    def __post_init__(self) -> None:
        for name in ("last", "hidden"):
            super().__setitem__(name, getattr(self, name))

    def __setitem__(self, key: str, value: Any) -> None:
        super().__setitem__(key, value)
        super().__setattr__(key, value)


class Block(nn.Module):
    def __init__(self, width: int):
        super().__init__()
        self.norm1, self.norm2 = nn.LayerNorm(width), nn.LayerNorm(width)
        self.attention = nn.MultiheadAttention(width, 2, batch_first=True)
        self.mlp = nn.Sequential(
            nn.Linear(width, 2 * width), nn.GELU(), nn.Linear(2 * width, width)
        )

    def forward(self, x: Tensor, *, scale: float = 1.0) -> tuple[Tensor, None]:
        y = self.norm1(x)
        x = x + scale * self.attention(y, y, y, need_weights=False)[0]
        return x + scale * self.mlp(self.norm2(x)), None


class ViT(nn.Module):
    def __init__(self, width: int = 8):
        super().__init__()
        self.patches = nn.Conv2d(3, width, 4, 4)
        self.position = nn.Parameter(torch.randn(1, 16, width) * 0.1)
        self.drop = nn.Dropout(0.1)
        self.blocks = nn.ModuleList(Block(width) for _ in range(3))
        self.norm = nn.LayerNorm(width)

    def forward(self, x: Tensor, output_hidden: bool = False) -> Encoded:
        x = self.drop(self.patches(x).flatten(2).transpose(1, 2) + self.position)
        hidden = [x]
        for block in self.blocks:
            x, _ = block(x, scale=0.5)
            hidden.append(x)
        return Encoded(last=self.norm(x), hidden=tuple(hidden) if output_hidden else None)


class ViTDepth(nn.Module):
    """A transformer with dataclass and dict outputs and keyword arguments."""

    def __init__(self) -> None:
        super().__init__()
        self.encoder = ViT()
        self.project, self.head = nn.Linear(16, 8), conv(8, 1)

    def forward(self, x: Tensor) -> dict[str, Tensor]:
        encoded = self.encoder(x, output_hidden=True)
        tokens = self.project(torch.cat([encoded.last, encoded["hidden"][1]], -1))
        grid = tokens.transpose(1, 2).unflatten(2, (4, 4))
        disparity = self.head(F.interpolate(grid, scale_factor=4.0, mode="bilinear"))
        return {"disparity": disparity.abs() + 0.5}


# ------------------------------------------------------------------ one difficulty each


class InPlace(nn.Module):
    """In-place operations on recorded outputs, right behind the cut and on the input."""

    def __init__(self) -> None:
        super().__init__()
        self.a, self.b, self.c, self.d = conv(3, 4), conv(4, 4), conv(4, 4), conv(4, 1)
        self.relu = nn.ReLU(inplace=True)
        self.flat = nn.Flatten(2)

    def forward(self, x: Tensor) -> Tensor:
        x -= 0.5
        a = self.a(x)
        first = self.relu(a)  # the same tensor as a
        b = self.b(first)
        F.relu_(b)
        b = b + a if b.requires_grad else b.add_(a)
        a = a * 1.5 if a.requires_grad else a.mul_(1.5)
        flat = self.flat(b)
        flat.add_(0.25)  # changes b too
        c = self.c(b)
        c = c + 1 if c.requires_grad else torch.add(c, 1, out=c)
        c += x.mean()
        return self.d(c + a).abs_().add_(1)


class ResidualUnit(nn.Module):
    """As in MiDaS: the in-place ReLU changes x itself, which is then added."""

    def __init__(self, channels: int):
        super().__init__()
        self.conv1, self.conv2 = conv(channels, channels), conv(channels, channels)
        self.relu = nn.ReLU(inplace=True)

    def forward(self, x: Tensor) -> Tensor:
        out = self.conv1(self.relu(x))
        return self.conv2(self.relu(out)) + x


class MiDaSLike(nn.Module):
    """Forward hooks store features; the network clears and reads what they stored."""

    def __init__(self) -> None:
        super().__init__()
        self.backbone = nn.Sequential(conv(3, 4), nn.ReLU(inplace=True), conv(4, 4), conv(4, 4))
        self.unit1, self.unit2, self.head = ResidualUnit(4), ResidualUnit(4), conv(4, 1)
        self.features: list[Tensor] = []
        for index in (0, 2):
            self.backbone[index].register_forward_hook(
                lambda module, inputs, output: self.features.append(output)
            )

    def forward(self, x: Tensor) -> Tensor:
        self.features.clear()
        deep = self.backbone(x)
        first, second = self.features
        y = self.unit1(first * 0.5) + second
        return self.head(self.unit2(y + deep)).abs() + 1


class Branching(nn.Module):
    """Python branches on values, before the cut and behind it."""

    def __init__(self, escape: Callable[[Tensor], bool] = lambda y: bool(y.mean() > 0.3)) -> None:
        super().__init__()
        self.a, self.cut, self.side = conv(3, 4), conv(4, 4), conv(4, 4)
        self.relu = nn.ReLU(inplace=True)
        self.head = conv(4, 1)
        self.escape = escape

    def forward(self, x: Tensor) -> Tensor:
        a = self.a(x)
        if a.mean() > 0:
            a = -a
        y = self.cut(a)
        if self.escape(y.detach()):
            y = y + self.side(a)
        else:
            a = F.relu(a) if a.requires_grad else self.relu(a)
            y = y - self.side(y) + a
        return self.head(y).abs() + 1


class Repeated(nn.Module):
    """One submodule before the cut, at it, and behind it; shared weights under two names."""

    def __init__(self) -> None:
        super().__init__()
        self.enter = conv(3, 4)
        self.same = conv(4, 4)
        self.norm = nn.BatchNorm2d(4)
        self.alias = self.enter
        self.head = conv(4, 1)
        self.tied = conv(4, 4)
        self.tied.weight = self.same.weight

    def forward(self, x: Tensor) -> Tensor:
        x = self.norm(self.enter(x))
        x = self.norm(self.same(x))
        x = self.same(x).relu_()
        x = x + self.norm(self.same(x)) + self.tied(x)
        return self.head(x).abs() + 1


@dataclass(frozen=True)
class Frozen:
    deep: Tensor
    shallow: Tensor
    scale: float = 2.0


class Structured(nn.Module):
    """The cut layer returns a structure; the network changes the rest of it in place."""

    makes: dict[str, Callable[[Tensor, Tensor], Any]] = {  # noqa: RUF012
        "tuple": lambda a, b: (a, b),
        "dict": lambda a, b: {"deep": a, "shallow": b},
        "dataclass": Frozen,
        "nested": lambda a, b: {"out": [(a, 3), {"x": b}], 5: "text"},
    }

    def __init__(self, kind: str):
        super().__init__()
        self.kind = kind
        self.enter, self.cut = conv(3, 4), StructuredCut(kind)
        self.head = conv(4, 1)

    def forward(self, x: Tensor) -> Tensor:
        out = self.cut(self.enter(x))
        if self.kind == "nested":
            deep, shallow = out["out"][0][0], out["out"][1]["x"]
            out["out"].pop()
        elif self.kind == "dict":
            deep, shallow = out.pop("deep"), out.pop("shallow")
        elif self.kind == "dataclass":
            deep, shallow = out.deep, out.shallow
        else:
            deep, shallow = out
        shallow += 1
        shallow.relu_()
        return self.head(deep * shallow).abs() + 1


class StructuredCut(nn.Module):
    def __init__(self, kind: str):
        super().__init__()
        self.make = Structured.makes[kind]
        self.a, self.b = conv(4, 4), conv(4, 4)

    def forward(self, x: Tensor) -> Any:
        return self.make(self.a(x), self.b(x))


class Counting(nn.Module):
    """A layer that counts its calls in `calls`."""

    def __init__(self, inner: nn.Module):
        super().__init__()
        self.inner, self.calls = inner, 0

    def forward(self, *args: Any, **kwargs: Any) -> Any:
        self.calls += 1
        return self.inner(*args, **kwargs)


class Detached(nn.Module):
    """A branch that depends on z, but not by any gradient."""

    def __init__(self) -> None:
        super().__init__()
        self.branch = conv(4, 4)

    def forward(self, z: Tensor) -> Tensor:
        chosen = torch.arange(4)[:, None, None] == z.argmax(1, keepdim=True)
        return self.branch(chosen.float())


class TwoBranches(nn.Module):
    """Behind the cut, one branch looks at the image only, one at z only through argmax."""

    def __init__(self) -> None:
        super().__init__()
        self.front, self.cut = Counting(conv(3, 4)), conv(4, 4)
        self.guide = Counting(nn.Sequential(conv(3, 4), nn.ReLU(inplace=True), conv(4, 4)))
        self.detached = Counting(Detached())
        self.head = Counting(conv(4, 1))

    def forward(self, x: Tensor) -> Tensor:
        z = self.cut(self.front(x))
        guide = self.guide(x)
        guide += 0.1
        return self.head(z * guide + self.detached(z)).abs() + 1


class Appends(nn.Module):
    """Gives its features to a list it was handed, and returns its input."""

    def __init__(self) -> None:
        super().__init__()
        self.conv = conv(4, 4)

    def forward(self, x: Tensor, into: list[Tensor]) -> Tensor:
        into.append(self.conv(x))
        return x


class SideEffects(nn.Module):
    """Parts that change their list argument; an object that hides tensors."""

    def __init__(self) -> None:
        super().__init__()
        self.enter, self.one, self.two, self.cut = conv(3, 4), Appends(), Appends(), conv(4, 4)
        self.hide, self.head = Hides(), conv(4, 1)

    def forward(self, x: Tensor) -> Tensor:
        tensors: list[Tensor] = []
        x = self.two(self.one(self.enter(x), tensors), into=tensors)
        hidden = self.hide(x)
        hidden.tensor += 1
        z = self.cut(x) + hidden.tensor
        return self.head(z * tensors[0] + tensors[1]).abs() + 1


class Hides(nn.Module):
    class Box:
        def __init__(self, tensor: Tensor):
            self.tensor = tensor

    def __init__(self) -> None:
        super().__init__()
        self.conv = conv(4, 4)

    def forward(self, x: Tensor) -> Any:
        return self.Box(self.conv(x))


class Updating(nn.Module):
    """Buffers that every forward changes, in place and by assignment."""

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("passes", torch.zeros(()))
        self.register_buffer("average", torch.zeros(1, 4, 1, 1))
        self.enter, self.cut, self.head = conv(3, 4), conv(4, 4), conv(4, 1)

    def forward(self, x: Tensor) -> Tensor:
        self.passes += 1
        y = self.enter(x)
        self.average = 0.5 * self.average + 0.5 * y.mean((2, 3), keepdim=True)
        return self.head(self.cut(y * self.passes) + self.average).abs() + 1


def wrapped(function: Callable[..., Any]) -> Callable[..., Any]:
    @functools.wraps(function)
    def forward(self: nn.Module, *args: Any, **kwargs: Any) -> Any:
        return function(self, *args, **kwargs)

    return forward


class Direct(nn.Module):
    """Calls forward() itself, methods of submodules, a decorated forward, parametrizations."""

    def __init__(self) -> None:
        super().__init__()
        self.enter = nn.utils.parametrizations.weight_norm(conv(3, 4))
        self.spectral = nn.utils.parametrizations.spectral_norm(conv(4, 4))
        self.methods = Methods()
        self.head = conv(4, 1)

    @wrapped
    def forward(self, x: Tensor) -> Tensor:
        x = self.spectral.forward(self.enter.forward(x))
        x = self.methods.features(x) + self.methods(x=x)
        return self.head(x).abs() + 1


class Methods(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.a, self.b = conv(4, 4), conv(4, 4)

    def features(self, x: Tensor) -> Tensor:
        return self.b(self.a(x))

    @wrapped
    def forward(self, *, x: Tensor) -> Tensor:
        return self.a(x) * 2


class Scripted(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.enter = torch.jit.script(nn.Sequential(conv(3, 4), nn.ReLU()))
        self.cut, self.tail = conv(4, 4), torch.jit.script(conv(4, 4))
        self.frozen = torch.jit.freeze(torch.jit.script(conv(4, 1).eval()))

    def forward(self, x: Tensor) -> Tensor:
        return self.frozen(self.tail(self.cut(self.enter(x)))).abs() + 1


class Checkpointed(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.enter, self.cut, self.a, self.b = conv(3, 4), conv(4, 4), conv(4, 4), conv(4, 4)
        self.head = conv(4, 1)

    def block(self, y: Tensor, x: Tensor) -> Tensor:
        return self.b(torch.sigmoid(self.a(y)) * self.enter(x)).sin()

    def forward(self, x: Tensor) -> Tensor:
        y = self.cut(self.enter(x))
        y = checkpoint(self.block, y, x, use_reentrant=False)
        return self.head(y).abs() + 1


class HalfInference(nn.Module):
    """An encoder under inference_mode, a decoder outside it."""

    def __init__(self) -> None:
        super().__init__()
        self.enter, self.cut, self.head = InferenceConv(), conv(4, 4), conv(4, 1)

    def forward(self, x: Tensor) -> Tensor:
        x = self.enter(x)
        return self.head(self.cut(x) * x).abs() + 1


class InferenceConv(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.inner = conv(3, 4)

    @torch.inference_mode()
    def forward(self, x: Tensor) -> Tensor:
        return self.inner(x)


def native_scale(x: Tensor) -> Tensor:
    """As an extension in C++ does it: the values get over without a tensor operation."""
    out = torch.empty(x.shape)
    with torch._C.DisableTorchFunction(), torch.utils._python_dispatch._disable_current_modes():
        out.copy_(x.detach() * 2)
    return out


class NativeFunction(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        return native_scale(x)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:
        return gradient * 2


class NativeLayer(nn.Module):
    def forward(self, x: Tensor) -> Tensor:
        return NativeFunction.apply(x)


class Native(nn.Module):
    """An operator from outside torch whose reading of z no dispatcher sees."""

    def __init__(self) -> None:
        super().__init__()
        self.enter, self.cut, self.native = conv(3, 4), conv(4, 4), NativeLayer()
        self.after, self.head = conv(4, 4), conv(4, 1)

    def forward(self, x: Tensor) -> Tensor:
        return self.head(self.after(self.native(self.cut(self.enter(x))))).abs() + 1


class Catches(nn.Module):
    """A part that takes another way after any exception, in a part that does so too."""

    class Inner(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.cut, self.other = conv(4, 4), conv(4, 4, 1)

        def forward(self, x: Tensor) -> Tensor:
            try:
                return self.cut(x).relu()
            except Exception:
                return self.other(x)

    def __init__(self) -> None:
        super().__init__()
        self.enter, self.inner, self.plain = conv(3, 4), self.Inner(), nn.Sequential(conv(4, 4))
        self.head = conv(4, 1)

    def forward(self, x: Tensor) -> Tensor:
        x = self.enter(x)
        try:
            x = self.inner(x)
        except Exception:
            x = -x
        return self.head(self.plain(x) + x).abs() + 1


class UNetTail(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.a, self.b = conv(4, 4), conv(4, 1)

    def forward(self, x: Tensor) -> Tensor:
        y = self.a(x)
        y += x
        return self.b(y.relu_()).abs() + 1


def wrapped_network() -> nn.Module:
    wrapped = nn.DataParallel(nn.Sequential(nn.Sequential(conv(3, 4), nn.ReLU(True)), UNetTail()))
    wrapped.device_ids = []  # on the CPU, also where there are GPUs
    return wrapped.cpu()


NETWORKS: dict[str, Callable[[], nn.Module]] = {
    "unet": UNet,
    "vit": ViTDepth,
    "in place": InPlace,
    "midas": MiDaSLike,
    "branching": Branching,
    "repeated": Repeated,
    **{f"{kind} output": functools.partial(Structured, kind) for kind in Structured.makes},
    "two branches": TwoBranches,
    "side effects": SideEffects,
    "updating": Updating,
    "direct": Direct,
    "scripted": Scripted,
    "checkpointed": Checkpointed,
    "half inference": HalfInference,
    "native": Native,
    "catches": Catches,
    "wrapped": wrapped_network,
}


def build(name: str) -> nn.Module:
    """The network of that name with fixed random weights, batch norms with statistics, training."""
    torch.manual_seed(0)
    network = NETWORKS[name]()
    for module in network.modules():
        if isinstance(module, nn.BatchNorm2d):
            nn.init.uniform_(module.running_mean, -0.5, 0.5)  # type: ignore[arg-type]
            nn.init.uniform_(module.running_var, 0.5, 1.5)  # type: ignore[arg-type]
    return network.train()


def image(height: int = 16, width: int = 16) -> Tensor:
    return torch.rand(1, 3, height, width, generator=torch.Generator().manual_seed(1))


def depth_of(output: Any) -> Tensor:
    """Depth (1, 1, h, w) of what any of the networks here returns."""
    return output["disparity"].reciprocal() if isinstance(output, dict) else output
