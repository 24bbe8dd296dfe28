"""The experts of a frame: whom to trust, the mirrored frame, the weighted mean."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from pnpdepth_cli.completion.residual_field import ResidualField
from pnpdepth_cli.frames.experts import Experts, NetworkExpert, trust, weighted_mean, with_mirrored
from pnpdepth_cli.frames.frame import Frame
from pnpdepth_cli.frames.open_network import MIRRORED_BELOW
from pnpdepth_cli.frames.refine_frame import Pipeline, refine_frame
from pnpdepth_cli.frames.strength import OutlierSearch, strength_of, unexplained_by
from pnpdepth_cli.frames.validation import MIN_POINTS
from pnpdepth_cli.points import SparsePoints
from pnpdepth_cli.settings import ClosedSettings
from tests.frames.scenes import (
    SIZE,
    Brightness,
    Nearest,
    compact,
    depth_of_scene,
    frame_in_memory,
    member,
    network_expert,
    opened,
    split_of,
)


@pytest.mark.parametrize(("known", "noise"), [(4, 0.1), (5, 0.1), (40, 0.18), (40, 0.3), (40, 9)])
def test_trust_is_what_lines_through_the_other_points_explain(known: int, noise: float) -> None:
    frame = frame_in_memory(60)
    rng = np.random.default_rng(known)
    pixels = tuple(frame.points.xy.long().numpy().T[::-1, :known])
    y = frame.points.depth.double().log().numpy()[:known]
    x = 0.3 * y + noise * 0.3 * rng.normal(size=known)
    predicted = torch.zeros(SIZE, dtype=torch.float64)
    predicted[pixels] = torch.from_numpy(x).exp()
    one = replace(
        network_expert("net", torch.ones(60)), from_all=SimpleNamespace(aligned=predicted)
    )
    split = replace(split_of(frame.points.depth), whole=frame, kept=frame)
    press = total = 0.0
    for left_out in range(known):
        rest = np.arange(known) != left_out
        line = np.polyfit(x[rest], y[rest], 1)
        press += (y[left_out] - np.polyval(line, x[left_out])) ** 2
        total += (y[left_out] - y[rest].mean()) ** 2
    rises = np.polyfit(x, y, 1)[0] > 0 and known >= MIN_POINTS
    expected = np.clip((1 - press / total - 0.25) / 0.5, 0, 1) if rises else 0
    alone = network_expert("compact", torch.ones(60))
    assert trust(member(Brightness), one, split, alone) == pytest.approx(expected, abs=1e-6)


def test_trust_in_a_network_that_takes_points_falls_with_its_error_at_validation_points() -> None:
    depth = torch.full((50,), 2.0)
    split = split_of(depth)
    alone = network_expert("compact", depth + 0.1)
    found = [
        trust(member(Nearest), network_expert("own", depth + off), split, alone)
        for off in (0.05, 0.1, 0.15, 0.2, 0.4)
    ]
    assert found == pytest.approx([1, 1, 0.5, 0, 0], abs=1e-4)


def seen_twice(frame: Frame, weight: float = 1.0) -> tuple[NetworkExpert, NetworkExpert]:
    """An expert of `compact`, before and after it sees the mirrored frame, if it does."""
    at = frame.points.depth[:0]
    with opened(compact()) as networks:
        whole = networks[0].refine(frame)
        expert = NetworkExpert(
            name="compact",
            at_validation=at,
            updated_at_validation=at,
            points=frame.points,
            from_all=whole,
            from_others=whole,
            frame=frame,
        )
        experts = Experts(first_of_user=expert, without_prior=None, every=[expert])
        again = with_mirrored(networks[0], experts, {"compact": weight}).first_of_user
    return expert, again


def test_few_points_give_the_geometric_mean_of_the_frame_and_the_mirrored_one() -> None:
    frame = frame_in_memory(count=MIRRORED_BELOW - 1)
    once, twice = seen_twice(frame)
    turned, _ = seen_twice(frame.mirrored())
    left = once.from_all.updated.numpy()
    right = turned.from_all.updated.numpy()[:, ::-1]
    assert np.abs(left - right).max() > 1e-3
    np.testing.assert_allclose(twice.dense, np.sqrt(left * right), rtol=1e-4)


@pytest.mark.parametrize(("count", "weight"), [(MIRRORED_BELOW, 1.0), (20, 0.0)])
def test_many_points_or_no_weight_show_an_expert_the_frame_alone(count: int, weight: float) -> None:
    once, twice = seen_twice(frame_in_memory(count), weight)
    assert twice is once


def test_the_weighted_mean_is_geometric_and_skips_unknown_depth() -> None:
    one, other = torch.tensor([[4.0, 0.0, 0.0], [1.0, 3.0, 0.0]])
    mean = weighted_mean([(one, 0.25), (other, 0.75)])
    assert torch.allclose(mean, torch.tensor([4.0**0.25, 3.0, 0.0]))
    alone = torch.tensor([2.0, 3.0, 7.0, 0.0])
    assert torch.equal(weighted_mean([(alone, 0.3), (alone + 1, 0.0)]), alone)


def search_with(points: SparsePoints) -> OutlierSearch:
    """A frame of these points whose outliers were sought beside a constant depth."""
    network = member(Brightness)
    frame = replace(frame_in_memory(), points=points)
    constant = ResidualField(torch.ones(SIZE), points, frame.rgb)
    return OutlierSearch(
        network, frame, network_expert("net", points.depth).from_all, None, constant
    )


def test_a_network_is_strong_as_far_as_its_depth_predicts_points_from_each_other() -> None:
    frame = frame_in_memory(100)
    split = replace(split_of(frame.points.depth), whole=frame)
    search = search_with(frame.points)
    generator = torch.Generator().manual_seed(3)
    noise = torch.randn(SIZE, generator=generator)
    found = [
        unexplained_by(depth_of_scene() * (error * noise).exp(), split, search)
        for error in (0.0, 0.002, 0.5)
    ]
    assert found == sorted(found)
    assert [strength_of(found[0]), strength_of(found[-1])] == [1, 0]
    few = replace(split, whole=replace(frame, points=frame.points.select(slice(MIN_POINTS - 1))))
    lines = replace(split, has_scan_lines=True)
    assert [unexplained_by(depth_of_scene(), points, search) for points in (few, lines)] == [1, 1]


@pytest.mark.parametrize(("stated", "updates"), [(False, 0), (True, 3)])
def test_z_of_a_strong_network_is_updated_only_if_the_user_says_so(
    stated: bool, updates: int
) -> None:
    class Exact(Brightness):
        def forward(self, rgb: torch.Tensor) -> torch.Tensor:
            return self.layer(depth_of_scene()[None, None] + 0 * rgb[:, :1])

    frame = frame_in_memory(60)
    settings = ClosedSettings(iterations=3, lr="5%", align="scale")
    network = member(Exact, settings=settings, always_updated=stated)
    with opened(network, compact()) as networks:
        result = refine_frame(networks, frame, Pipeline())
    assert len(result.losses) - 1 == updates
    assert result.weights["exact"] > 0.3


def test_of_two_networks_the_one_that_explains_more_has_more_of_the_prior_weight() -> None:
    class Exact(Brightness):
        def forward(self, rgb: torch.Tensor) -> torch.Tensor:
            return self.layer(depth_of_scene()[None, None] + 0 * rgb[:, :1])

    settings = ClosedSettings(iterations=0, align="scale")
    members = [member(Exact, settings=settings), member(Brightness, settings=settings)]
    with opened(*members, compact()) as networks:
        weights = refine_frame(networks, frame_in_memory(60), Pipeline()).weights
    assert weights["exact"] > 3 * weights["brightness"]
