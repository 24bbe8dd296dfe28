"""The network that comes with the program, with random weights: shapes, scale, gradients."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from model_zoo_defs._compact.cloud import Cloud
from model_zoo_defs._compact.points import Points
from model_zoo_defs.compact import Compact, definitions
from pnpdepth_cli.core.split import Split, gradient_at
from pnpdepth_cli.models.network import load_network

definition = definitions["compact"]


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


def frame(height: int, width: int, count: int) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(0)
    rgb = torch.randn(1, 3, height, width, generator=generator)
    sparse = torch.zeros(height * width)
    at = torch.randperm(height * width, generator=generator)[:count]
    sparse[at] = 1.0 + 4.0 * torch.rand(len(at), generator=generator)
    return rgb, sparse.view(1, 1, height, width)


@pytest.mark.parametrize("points", [0, 1, 5, 500, 20_000, "row", "one depth"])
def test_depth_is_positive_and_repeatable_wherever_the_points_lie(
    network: Compact, points: int | str
) -> None:
    rgb, sparse = frame(128, 160, points if isinstance(points, int) else 0)
    if points == "row":
        sparse[..., 40, :] = torch.linspace(1, 5, 160)
    elif points == "one depth":
        sparse[..., ::7, ::7] = 2.0
    with torch.no_grad():
        depth = network(rgb, sparse)
        assert torch.equal(network(rgb, sparse), depth)
    assert depth.shape == (1, 1, 128, 160)
    assert bool(torch.isfinite(depth).all())
    assert bool((depth > 0).all())


def prior_of(sparse: Tensor) -> Tensor:
    """A rough depth, with a window in which it is unknown."""
    prior = torch.where(sparse > 0, 1.1 * sparse, 2.5)
    prior[..., 10:30, 20:60] = 0.0
    return prior


def test_depth_scales_with_its_inputs_and_a_prior_that_is_unknown_everywhere_changes_nothing(
    network: Compact,
) -> None:
    rgb, sparse = frame(96, 128, 300)
    prior, unknown = prior_of(sparse), torch.zeros_like(sparse)
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
def test_rear_of_front_is_the_network_bit_for_bit_and_errors_reach_every_layer(
    network: Compact, layer: str, with_prior: bool
) -> None:
    assert definition.static_graph
    with Split(network, layer, static_graph=True) as split:
        # from no point at all to nearly every cell seen
        for count in (60, 0, 1, 3000, 200):
            rgb, sparse = frame(96, 128, count)
            inputs = [rgb, sparse, *([prior_of(sparse)] if with_prior else [])]
            z = split.front(*inputs).requires_grad_(True)
            depth = split.rear(z)
            with torch.no_grad():
                assert torch.equal(depth, network(*inputs))
        gradient = gradient_at(z, (depth - sparse)[sparse > 0].abs().mean())
    assert gradient is not None
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
