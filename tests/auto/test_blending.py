from __future__ import annotations

import torch
from hypothesis import given
from hypothesis import strategies as st

from pnpdepth_cli.auto.blending import best_blend, held_out_error, weighted_mean


def test_a_candidate_without_error_is_taken_alone() -> None:
    depth = torch.tensor([1.0, 2.0, 3.0])
    blend = best_blend(
        torch.stack([depth + 0.1, depth, depth - 0.3]), depth, torch.ones(3), default=0
    )
    assert (blend.members, blend.weights, blend.error) == ((1,), (1.0,), 0.0)


def test_two_with_errors_of_opposite_sign_are_mixed() -> None:
    depth = torch.tensor([1.0, 2.0, 3.0, 4.0])
    blend = best_blend(torch.stack([depth + 0.1, depth - 0.3]), depth, torch.ones(4), default=0)
    assert blend.members == (0, 1)
    assert blend.weights == (0.75, 0.25)
    assert not blend.geometric
    assert blend.error < 1e-6


def test_two_with_opposite_factors_are_mixed_geometrically() -> None:
    depth = torch.tensor([1.0, 2.0, 3.0, 4.0])
    blend = best_blend(torch.stack([depth * 2, depth / 2]), depth, torch.ones(4), default=0)
    assert blend.geometric
    assert blend.weights == (0.5, 0.5)
    assert blend.error < 1e-6


def test_a_mean_takes_what_is_known() -> None:
    depths = torch.tensor([[1.0, 0.0, 0.0], [4.0, 3.0, 0.0]])
    assert weighted_mean(depths, (0.5, 0.5), geometric=True).tolist() == [2.0, 3.0, 0.0]
    assert weighted_mean(depths, (0.5, 0.5), geometric=False).tolist() == [2.5, 3.0, 0.0]


def test_a_bound_is_taken_only_where_everything_else_is_worse() -> None:
    depth = torch.tensor([1.0, 2.0, 3.0, 4.0]).repeat(20)
    bound, better, worse = depth * 1.1, depth * 1.05, depth * 1.3
    chosen = best_blend(
        torch.stack([bound, better]), depth, torch.ones(80), default=1, baselines=[0], bounds=[0]
    )
    assert chosen.members == (1,)
    chosen = best_blend(
        torch.stack([bound, worse]), depth, torch.ones(80), default=1, baselines=[0], bounds=[0]
    )
    assert chosen.members == (0,)


def test_a_point_without_weight_does_not_count() -> None:
    depth = torch.tensor([1.0, 2.0, 50.0])
    weights = torch.tensor([1.0, 1.0, 0.0])
    predicted = torch.tensor([[1.0, 2.0, 3.0], [1.1, 2.1, 50.0]])
    assert best_blend(predicted, depth, weights, default=1).members == (0,)
    assert torch.allclose(held_out_error(predicted, depth, weights), torch.tensor([0.0, 0.1]))


@given(seed=st.integers(0, 1000), candidates=st.integers(1, 9), points=st.integers(60, 90))
def test_what_is_chosen_is_never_worse_than_the_best_candidate(
    seed: int, candidates: int, points: int
) -> None:
    generator = torch.Generator().manual_seed(seed)
    depth = 1 + torch.rand(points, generator=generator)
    predicted = depth + torch.rand(candidates, points, generator=generator) - 0.5
    weights = torch.rand(points, generator=generator) + 0.1
    blend = best_blend(predicted, depth, weights, default=0, baselines=range(candidates))
    assert blend.error <= float(held_out_error(predicted, depth, weights).min()) + 1e-6
    assert abs(sum(blend.weights) - 1) < 1e-9
    mean = weighted_mean(predicted[list(blend.members)], blend.weights, geometric=blend.geometric)
    assert abs(float(held_out_error(mean, depth, weights)) - blend.error) < 1e-5
