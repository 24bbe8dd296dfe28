"""The network that comes with the program, with random weights: shapes, scale, gradients."""

from __future__ import annotations

from typing import NamedTuple

import pytest
import torch
from torch import Tensor

from model_zoo_defs._compact.cloud import CELLS, SAME_DEPTH, Cloud, thinned
from model_zoo_defs._compact.points import Points
from model_zoo_defs._compact.prior import Prior
from model_zoo_defs.compact import Compact, definitions
from pnpdepth_cli.core.split import Split, gradient_at
from pnpdepth_cli.models.network import load_network

definition = definitions["compact"]
HEIGHT, WIDTH = 96, 128


@pytest.fixture(scope="module")
def network() -> Compact:
    """Random weights also where training begins at zero, so that every path shows."""
    torch.manual_seed(0)
    net = Compact().eval()
    for name, parameter in net.named_parameters():
        if "prior" in name or name.startswith(("inlier_weights.", "scale.")):
            torch.nn.init.normal_(parameter, std=0.05)
    for head in net.heads.values():
        torch.nn.init.normal_(head.weigh.weight, std=0.05)
    return net


def frame(count: int) -> tuple[Tensor, Tensor]:
    """An image, and so many points."""
    generator = torch.Generator().manual_seed(0)
    rgb = torch.randn(1, 3, HEIGHT, WIDTH, generator=generator)
    sparse = torch.zeros(HEIGHT * WIDTH)
    at = torch.randperm(HEIGHT * WIDTH, generator=generator)[:count]
    sparse[at] = 1.0 + 4.0 * torch.rand(len(at), generator=generator)
    return rgb, sparse.view(1, 1, HEIGHT, WIDTH)


def prior_of(sparse: Tensor) -> Tensor:
    """A rough depth, with a window in which it is unknown."""
    prior = torch.where(sparse > 0, 1.1 * sparse, 2.5)
    prior[..., 10:30, 20:60] = 0.0
    return prior


def test_depth_scales_with_its_inputs_and_an_unknown_prior_does_nothing(network: Compact) -> None:
    rgb, sparse = frame(300)
    prior = prior_of(sparse)
    unknown = torch.zeros_like(sparse)
    with torch.no_grad():
        pairs = (
            (network(rgb, 10 * sparse), 10 * network(rgb, sparse)),
            (network(rgb, 10 * sparse, 10 * prior), 10 * network(rgb, sparse, prior)),
            (network(rgb, sparse, unknown), network(rgb, sparse)),
        )
    for depth, expected in pairs:
        torch.testing.assert_close(depth, expected, rtol=1e-3, atol=0.0)


@pytest.mark.parametrize("with_prior", [False, True])
@pytest.mark.parametrize("layer", definition.layers)
def test_wherever_points_lie_rear_of_front_is_the_network_and_errors_reach_every_layer(
    network: Compact, layer: str, with_prior: bool
) -> None:
    assert definition.static_graph
    row, same = torch.zeros(2, 1, 1, HEIGHT, WIDTH)
    row[..., 40, :] = torch.linspace(1, 5, WIDTH)
    same[..., ::7, ::7] = 2.0
    rgb, some = frame(200)
    with Split(network, layer, static_graph=True) as split:
        for sparse in (*(frame(count)[1] for count in (60, 0, 1, 20_000)), row, same, some):
            inputs = [rgb, sparse, *([prior_of(sparse)] if with_prior else [])]
            z = split.front(*inputs).requires_grad_(True)
            depth = split.rear(z)
            with torch.no_grad():
                assert torch.equal(depth, network(*inputs))
            assert depth.shape == sparse.shape
            assert bool((torch.isfinite(depth) & (depth > 0)).all())
        gradient = gradient_at(z, (depth - some)[some > 0].abs().mean())
    assert float((gradient != 0).float().mean()) > 0.3


def test_the_shipped_inlier_weights_detect_outliers_on_a_slope() -> None:
    network = load_network("compact", None).module
    generator = torch.Generator().manual_seed(5)
    rows, columns = torch.meshgrid(torch.arange(192.0), torch.arange(256.0), indexing="ij")
    ground_truth = (2.0 + 0.005 * rows + 0.003 * columns).view(1, 1, 192, 256)
    known = torch.rand(ground_truth.shape, generator=generator) < 0.01
    outlier = known & (torch.rand(ground_truth.shape, generator=generator) < 0.2)
    with_outliers = ground_truth * known * torch.where(outlier, 2.0, 1.0)
    grey = torch.zeros(1, 3, 192, 256)
    with torch.no_grad():
        all_points = map(Points, (ground_truth * known, with_outliers))
        clean, mixed = (network.inlier_weights(p, Cloud.of(p, grey)) for p in all_points)
    assert float(clean[known].mean()) > 0.98
    assert float(mixed[known & ~outlier].mean()) > 0.95
    assert float(mixed[outlier].mean()) < 0.3


def dense_frame(*, outliers: float) -> tuple[Tensor, Tensor]:
    """The depth (1, 1, 240, 320) of two slopes with a jump between them, and which are outliers."""
    generator = torch.Generator().manual_seed(5)
    rows, columns = torch.meshgrid(torch.arange(240.0), torch.arange(320.0), indexing="ij")
    truth = 2.0 + 0.005 * rows + 0.003 * columns + (columns > 150) * 1.5
    outlier = torch.rand(truth.shape, generator=generator) < outliers
    return torch.where(outlier, 2.0 * truth, truth)[None, None], outlier[None, None]


class Thinned(NamedTuple):
    """The points of a dense map and those chosen of them; `of` stands for each point."""

    value: Tensor
    rows: Tensor
    columns: Tensor
    chosen: Tensor
    of: Tensor
    sends: Tensor


@pytest.fixture(scope="module")
def dense_points() -> Thinned:
    depth, _ = dense_frame(outliers=0.05)
    value = depth.log().flatten()
    rows, columns = torch.nonzero(depth[0, 0]).T
    chosen, stand_in, sends = thinned(rows, columns, value, len(value))
    return Thinned(value, rows, columns, chosen, chosen[stand_in], sends)


def test_of_a_dense_map_fewer_than_half_of_the_points_are_chosen_and_fewer_send(
    dense_points: Thinned,
) -> None:
    count = len(dense_points.value)
    assert count / 16 <= int(dense_points.sends.sum()) <= CELLS
    assert int(dense_points.sends.sum()) < len(dense_points.chosen) < count / 2


def test_every_point_of_a_dense_map_has_one_of_its_depth_and_of_its_place_that_stands_for_it(
    dense_points: Thinned,
) -> None:
    value, rows, columns, chosen, of, _ = dense_points
    assert torch.equal(of[chosen], chosen)
    assert int((rows[of] - rows).abs().max()) < 4
    assert int((columns[of] - columns).abs().max()) < 4
    assert float((value[of] - value).abs().max()) < 3 * SAME_DEPTH


def test_of_points_that_are_not_dense_each_stands_for_itself() -> None:
    _, sparse = frame(3000)
    rows, columns = torch.nonzero(sparse[0, 0]).T
    chosen, stand_in, sends = thinned(rows, columns, sparse[sparse > 0].log(), sparse.numel())
    assert torch.equal(chosen, torch.arange(3000))
    assert torch.equal(stand_in, chosen)
    assert bool(sends.all())


def test_the_shipped_inlier_weights_detect_outliers_of_a_dense_map_beside_a_jump() -> None:
    network = load_network("compact", None).module
    grey = torch.zeros(1, 3, 240, 320)
    depth, outlier = dense_frame(outliers=0.2)
    clean, _ = dense_frame(outliers=0.0)
    with torch.no_grad():
        of_clean, mixed = (
            network.inlier_weights(points, Cloud.of(points, grey))
            for points in map(Points, (clean, depth))
        )
    assert float(of_clean.mean()) > 0.999
    assert float(mixed[~outlier].mean()) > 0.95
    assert float(mixed[outlier].mean()) < 0.05


def test_a_dense_map_has_the_same_weights_and_trust_in_a_prior_in_a_batch(network: Compact) -> None:
    dense, _ = dense_frame(outliers=0.1)
    sparse = dense * (torch.rand(dense.shape, generator=torch.Generator().manual_seed(0)) < 0.01)
    both = torch.cat([sparse, dense])
    rgb = torch.zeros(2, 3, 240, 320)
    points = Points(both)
    cloud = Cloud.of(points, rgb)
    points.weigh(network.inlier_weights(points, cloud))
    valid = Prior.of(both.clamp_min(2.5), points, cloud).valid
    for number in range(2):
        alone = Points(both[number : number + 1])
        of_one = Cloud.of(alone, rgb[:1])
        alone.weigh(network.inlier_weights(alone, of_one))
        torch.testing.assert_close(alone.weight[0], points.weight[number], rtol=1e-4, atol=1e-4)
        prior = Prior.of(both[number : number + 1].clamp_min(2.5), alone, of_one)
        assert torch.equal(prior.valid[0], valid[number])
