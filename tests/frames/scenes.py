"""Small frames in memory, and networks of a line, for tests of the default method."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from pnpdepth_cli.frames.experts import NetworkExpert
from pnpdepth_cli.frames.frame import Frame, Prediction
from pnpdepth_cli.frames.open_network import OpenNetwork
from pnpdepth_cli.frames.validation import ValidatedFrame, whole_frame
from pnpdepth_cli.models.definition import ModelDefinition, Multiple
from pnpdepth_cli.models.network import Network, load_network
from pnpdepth_cli.points import SparsePoints
from pnpdepth_cli.settings import ClosedSettings

SIZE = (96, 128)


def depth_of_scene() -> Tensor:
    """(H, W) metres: two slanted planes with a step between them."""
    y, x = torch.meshgrid(*(torch.arange(float(n)) for n in SIZE), indexing="ij")
    return 1.5 + x / SIZE[1] + 0.5 * (y > SIZE[0] // 2)


def frame_in_memory(count: int = 60, seed: int = 1) -> Frame:
    """The scene with so many points; the image is its depth in grey, with noise."""
    rng = np.random.default_rng(seed)
    depth = depth_of_scene()
    pixels = rng.permutation(depth.numel())[:count]
    xy = torch.from_numpy(np.stack([pixels % SIZE[1], pixels // SIZE[1]], 1).astype(np.float32))
    points = SparsePoints(xy=xy, depth=depth.flatten()[torch.from_numpy(pixels)], size=SIZE)
    noise = torch.from_numpy(rng.random((3, *SIZE), dtype=np.float32))
    return Frame(rgb=(0.9 * (depth - 1.5) / 1.5 + 0.1 * noise).clamp(0, 1), points=points)


class Brightness(nn.Module):
    """Depth is linear in the image's brightness; the layer can move it."""

    def __init__(self) -> None:
        super().__init__()
        self.layer = nn.Identity()

    def forward(self, rgb: Tensor) -> Tensor:
        return 1.0 + self.layer(rgb.mean(1, keepdim=True))


class Nearest(nn.Module):
    """Depth is the mean of the points, 3 m where there is none."""

    def __init__(self) -> None:
        super().__init__()
        self.layer = nn.Identity()

    def forward(self, rgb: Tensor, sparse: Tensor) -> Tensor:
        mean = sparse.sum() / (sparse > 0).sum().clamp(min=1)
        return self.layer(torch.zeros_like(sparse) + mean)


def member(
    build: type[nn.Module],
    *,
    settings: ClosedSettings | None = None,
    always_updated: bool = False,
    **of_definition: Any,
) -> OpenNetwork:
    """The network as a member of the default method, by default without updates and alignment."""
    kind = "rgb" if issubclass(build, Brightness) else "rgb+sparse"
    definition = ModelDefinition(
        name=build.__name__.lower(),
        build=build,
        layers=("layer",),
        input_kind=kind,
        **({"size": Multiple(4)} | of_definition),
    )
    network = Network(
        definition=definition, module=build().eval(), device=torch.device("cpu"), checkpoint=None
    )
    settings = settings or ClosedSettings(iterations=0, align="none")
    return OpenNetwork(network, "layer", settings, always_updated=always_updated)


def compact() -> OpenNetwork:
    """`compact` without updates of z."""
    return OpenNetwork(load_network("compact", None), "decoder.s8", ClosedSettings(iterations=0))


@contextmanager
def opened(*members: OpenNetwork) -> Iterator[list[OpenNetwork]]:
    """The networks, open."""
    with ExitStack() as stack:
        yield [stack.enter_context(member) for member in members]


def network_expert(name: str, at: Tensor, weight: float = 1.0) -> NetworkExpert:
    """An expert with these predictions at the validation points."""
    points = frame_in_memory().points
    prediction = Prediction(
        aligned=depth_of_scene(),
        updated=depth_of_scene(),
        losses=(0.0,),
        step=0.0,
        diverged=None,
        alignment=None,
        notes=(),
    )
    return NetworkExpert(
        name=name,
        weight=weight,
        at_validation=at,
        updated_at_validation=at,
        points=points,
        from_all=prediction,
        from_others=prediction,
    )


def split_of(depth: Tensor) -> ValidatedFrame:
    """A frame with validation points of these depths."""
    xy = torch.stack([torch.arange(len(depth)) % 128, torch.arange(len(depth)) // 128], 1).float()
    points = SparsePoints(xy=xy, depth=depth, size=SIZE)
    whole = whole_frame(frame_in_memory(60), None)
    return replace(whole, points=points, weights=torch.ones(len(depth)))
