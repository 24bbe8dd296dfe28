"""What a network is given of a frame."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor, nn

from pnpdepth_cli.frames.frame import Frame
from pnpdepth_cli.frames.prepare import prepare
from pnpdepth_cli.models.definition import Fixed, ModelDefinition, Multiple, Normalisation
from pnpdepth_cli.models.network import Network
from pnpdepth_cli.points import SparsePoints
from tests.frames.scenes import TwicePrior, member

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


def test_a_reduced_frame_has_the_same_field_of_view_at_fewer_pixels() -> None:
    x = torch.arange(64.0)
    ramp, stripes = (x + 0.5).expand(32, 64), (x % 4 == 0).float().expand(32, 64)
    points = SparsePoints(
        xy=torch.tensor([[1.5, 1.5], [61.0, 30.0]]), depth=torch.tensor([2.0, 3.0]), size=(32, 64)
    )
    prior = torch.zeros(32, 64)
    prior[6, 10] = 7.0  # at the centre of cell (1, 2), which takes it; the others stay unknown
    rgb = torch.stack([ramp / 64, stripes, 1 - ramp / 64])
    frame = Frame(rgb=rgb, points=points, prior=prior)
    normalisation = Normalisation(mean=(0.5, 0.0, 0.5), std=(0.5, 1.0, 0.5))
    whole = prepare(member(TwicePrior, normalisation=normalisation).network, frame)
    reduced = whole.reduced(0.235)
    assert reduced is not None
    image, sparse, dense = reduced.arguments
    assert image is reduced.image
    assert image.shape == (1, 3, 8, 16)
    inner = image[0, :, :, 2:-2]
    expected = (torch.arange(2.0, 14.0) * 4 + 2) / 64 * 2 - 1
    torch.testing.assert_close(inner[0], expected.expand(8, 12))
    torch.testing.assert_close(inner[1], torch.full((8, 12), 0.25))  # the mean, not every fourth
    torch.testing.assert_close(inner[2], -inner[0])
    assert reduced.points.xy.tolist() == [[0.0, 0.0], [14.875, 7.125]]
    assert sparse.nonzero().tolist() == [[0, 0, 0, 0], [0, 0, 7, 15]]
    assert dense is reduced.prior
    assert dense.nonzero().tolist() == [[0, 0, 1, 2]]
    assert dense.max() == 7
    assert (reduced.map, reduced.frame) == (whole.map, whole.frame)
    assert whole.reduced(1.01) is None  # the same size
    assert prepare(network(weighs_points=True), FRAME).reduced(0.5) is None  # takes one size only


def test_the_smallest_reduced_frame_is_one_cell() -> None:
    points = SparsePoints(xy=torch.zeros(1, 2), depth=torch.ones(1), size=(32, 64))
    frame = Frame(rgb=torch.zeros(3, 32, 64), points=points)
    network = member(TwicePrior, size=Multiple(16)).network
    reduced = prepare(network, frame).reduced(0.01)
    assert reduced is not None
    assert [tuple(argument.shape[-2:]) for argument in reduced.arguments] == [(16, 16)] * 2
