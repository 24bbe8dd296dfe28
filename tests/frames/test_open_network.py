"""What a network is given of a frame."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor, nn

from pnpdepth_cli.frames.frame import Frame
from pnpdepth_cli.frames.open_network import prepare
from pnpdepth_cli.models.definition import Fixed, ModelDefinition
from pnpdepth_cli.models.network import Network
from pnpdepth_cli.points import SparsePoints

POINTS = SparsePoints(
    xy=torch.tensor([[0.0, 0.0], [3.0, 1.0], [2.0, 2.0]]),
    depth=torch.tensor([1.0, 2.0, 30.0]),
    size=(4, 4),
)
OUTLIERS = torch.tensor([False, False, True])
FRAME = Frame(rgb=None, points=POINTS).without(OUTLIERS)


class Same(nn.Module):
    """Depth is the sparse depth."""

    def forward(self, sparse: Tensor) -> Tensor:
        return sparse


def network(*, weighs_points: bool) -> Network:
    definition = ModelDefinition(
        name="same", build=Same, size=Fixed(2, 2), input_kind="sparse", weighs_points=weighs_points
    )
    return Network(
        definition=definition, module=Same(), device=torch.device("cpu"), checkpoint=None
    )


def test_a_frame_keeps_its_outliers_apart() -> None:
    assert FRAME.points.depth.tolist() == [1.0, 2.0]
    assert FRAME.outliers is not None
    assert FRAME.outliers.depth.tolist() == [30.0]


@pytest.mark.parametrize("weighs_points", [True, False])
def test_only_a_network_that_weighs_its_points_is_given_the_outliers_too(
    weighs_points: bool,
) -> None:
    prepared = prepare(network(weighs_points=weighs_points), FRAME)
    (sparse,) = prepared.arguments
    assert sparse[0, 0].tolist() == [[1.0, 2.0], [0.0, 30.0 if weighs_points else 0.0]]
    assert prepared.points.depth.tolist() == [1.0, 2.0]
