"""Notes on the alignment of a network's output with the points."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn

from pnpdepth_cli.models.aligned import AlignedDepth
from pnpdepth_cli.models.definition import ModelDefinition, Multiple
from pnpdepth_cli.models.network import Network
from pnpdepth_cli.points import SparsePoints

DEFINITION = ModelDefinition(
    name="net", input_kind="rgb", size=Multiple(1), build=nn.Identity, output_scale="affine"
)
NETWORK = Network(
    definition=DEFINITION, module=nn.Identity(), device=torch.device("cpu"), checkpoint=None
)


def points(count: int, depth: Tensor) -> SparsePoints[Tensor]:
    rng = np.random.default_rng(0)
    xy = torch.from_numpy(rng.integers(0, 40, (count, 2)).astype(np.float32))
    at = depth[0, 0, xy[:, 1].long(), xy[:, 0].long()]
    return SparsePoints(xy=xy, depth=at, size=(40, 40))


def notes(output: Tensor, depth: Tensor, count: int = 200) -> str:
    reader = AlignedDepth(NETWORK, points(count, depth), "auto")
    reader(output)
    return " ".join(reader.notes)


def test_a_network_that_is_no_better_than_the_median_depth_is_named() -> None:
    generator = torch.Generator().manual_seed(0)
    depth = torch.exp(torch.rand(1, 1, 40, 40, generator=generator) * 2)
    unrelated = torch.rand(1, 1, 40, 40, generator=generator)
    assert "network 'net' says nothing about this scene" in notes(unrelated, depth)
    assert "says nothing" not in notes(0.3 * depth + 1, depth)
    noisy = 0.3 * depth + 0.5 * unrelated
    assert "says nothing" not in notes(noisy, depth)
    assert "says nothing" not in notes(unrelated, depth, count=10)
