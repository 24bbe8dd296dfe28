"""Weights that learn from frames in memory, `Refiner(adapt=…)`."""

from __future__ import annotations

import copy
from collections.abc import Iterable, Iterator
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy.stats import ttest_rel

import pnpdepth_cli as pnp
from pnpdepth_cli.frames import adapt
from pnpdepth_cli.frames.frame import Frame
from pnpdepth_cli.frames.open_network import prepare
from tests.frames.scenes import SIZE, frame_in_memory

SETTINGS = pnp.Settings(method="paper", iterations=0)


def pair(seed: int, count: int = 60) -> tuple[NDArray[np.float32], pnp.SparsePoints]:
    frame = frame_in_memory(count, seed)
    return np.ascontiguousarray(frame.rgb.permute(1, 2, 0).numpy()), frame.points


def named(seeds: Iterable[int]) -> Iterator[tuple[str, Frame]]:
    return ((str(seed), frame_in_memory(seed=seed)) for seed in seeds)


FRAMES = [pair(seed) for seed in range(8)]


@pytest.fixture
def network(monkeypatch: pytest.MonkeyPatch) -> pnp.Network:
    monkeypatch.setattr(adapt, "STEPS", 10)
    return pnp.load_network("sparse2dense-tiny")


def test_learnt_weights_are_used_until_the_refiner_is_closed(
    network: pnp.Network, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("scipy.stats.ttest_1samp", lambda *a, **k: SimpleNamespace(pvalue=0.01))
    before = copy.deepcopy(network.module.state_dict())
    own = pnp.refine(network, *FRAMES[0], SETTINGS)
    with pnp.Refiner(network, SETTINGS, adapt=FRAMES) as refiner:
        learnt, again = (refiner.refine(*FRAMES[0]) for _ in range(2))
    assert any("% loss at hidden points of 4 frames" in note for note in learnt.notes)
    assert np.array_equal(learnt.depth, again.depth)
    expected = adapt.learn(network, named(range(8)))
    with adapt.weights_in_place(network, expected.weights):
        by_hand = pnp.refine(network, *FRAMES[0], SETTINGS)
    assert np.array_equal(learnt.depth, by_hand.depth)
    points = FRAMES[0][1]
    at_points = (points.sample(torch.from_numpy(result.depth)) for result in (own, learnt))
    before_learning, afterwards = ((at - points.depth).abs().mean() for at in at_points)
    assert afterwards < before_learning
    assert all(torch.equal(network.module.state_dict()[name], before[name]) for name in before)


@pytest.mark.parametrize(
    ("frames", "p_value", "why"),
    [(7, 0.01, "7 frames; at least 8 are needed"), (8, 0.2, "is not beyond chance")],
)
def test_without_proof_the_weights_of_the_network_stay(
    network: pnp.Network, monkeypatch: pytest.MonkeyPatch, frames: int, p_value: float, why: str
) -> None:
    monkeypatch.setattr("scipy.stats.ttest_1samp", lambda *a, **k: SimpleNamespace(pvalue=p_value))
    own = pnp.refine(network, *FRAMES[0], SETTINGS)
    with pnp.Refiner(network, SETTINGS, adapt=FRAMES[:frames]) as refiner:
        refined = refiner.refine(*FRAMES[0])
    assert why in "\n".join(refined.notes)
    assert np.array_equal(refined.depth, own.depth)


@pytest.mark.parametrize(
    ("name", "count", "error"),
    [("fcrn-tiny", 60, pnp.UsageError), ("sparse2dense-tiny", 1, pnp.NoPointsError)],
)
def test_a_network_without_points_and_a_frame_of_one_point_are_refused(
    name: str, count: int, error: type[pnp.PnpDepthError]
) -> None:
    frames = [*FRAMES, pair(8, count)]
    refiner = pnp.Refiner(pnp.load_network(name), SETTINGS, adapt=frames)
    with refiner, pytest.raises(error):
        refiner.refine(*FRAMES[0])


def test_updates_are_adams_on_the_loss_at_hidden_points(network: pnp.Network) -> None:
    learnt = adapt.learn(network, named(range(8)), seed=3)
    module = copy.deepcopy(network.module).requires_grad_()
    adam = torch.optim.Adam(module.parameters(), 0.0, eps=adapt.EPSILON)
    generator = torch.Generator().manual_seed(3)
    order = torch.randperm(4, generator=generator)
    for step in range(10):  # four on each of two frames and two on a third, whose halves are hidden
        if step % 4 == 0:  # frames 1, 3, 5 and 7 are for validation
            prepared = prepare(network, frame_in_memory(seed=2 * int(order[step // 4])))
            points = prepared.points
        if step % 2 == 0:
            parity = torch.randperm(len(points), generator=generator) % 2
        hidden = parity == step % 2
        output = network.depth_of(module(*prepared.arguments_for(points.select(~hidden))))
        asked = points.select(hidden)
        adam.zero_grad()
        (asked.sample(output).log() - asked.depth.log()).abs().mean().backward()
        adam.param_groups[0]["lr"] = adapt.LR * (1 + np.cos(np.pi * step / 10)) / 2
        adam.step()
    for name, parameter in module.named_parameters():
        torch.testing.assert_close(learnt.weights[name], parameter.detach(), rtol=1e-4, atol=1e-6)


def test_two_points_of_a_frame_are_enough(network: pnp.Network) -> None:
    learnt = adapt.learn(network, ((str(seed), frame_in_memory(2, seed)) for seed in range(8)))
    assert np.isfinite(learnt.after).all()


def test_few_frames_and_dense_points_teach_too_little() -> None:
    dense = SIZE[0] * SIZE[1] // 100  # 10 pixels apart
    cases = [(7, 60), (8, 60), (8, dense), (8, dense + 1)]
    why = [adapt.reason_not_to_learn(count, frame_in_memory(points)) for count, points in cases]
    assert [reason is None for reason in why] == [False, True, True, False]


def test_the_loss_of_each_validation_frame_is_compared_and_has_to_fall_beyond_chance() -> None:
    before = np.array([1.0, 2.0, 3.0, 2.0])
    after = np.array([0.8, 1.7, 2.7, 1.5])
    fallen, risen = (
        adapt.Learnt(weights={}, before=first, after=second)
        for first, second in ((before, after), (after, before))
    )
    chance = adapt.Learnt(weights={}, before=before, after=after[::-1])
    assert ttest_rel(np.log(after), np.log(before), alternative="less").pvalue < adapt.SIGNIFICANT
    assert [comparison.is_better for comparison in (fallen, risen, chance)] == [True, False, False]
    assert f"{6.7 / 8 - 1:+.1%}" in str(fallen)


def test_the_image_encoder_does_not_learn(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(adapt, "STEPS", 1)
    network = pnp.load_network("compact")
    own = dict(network.module.named_parameters())
    learnt = adapt.learn(network, named(range(4)))
    moved = {name for name, value in learnt.weights.items() if not torch.equal(value, own[name])}
    assert moved
    assert own.keys() - learnt.weights.keys() == {n for n in own if n.startswith("encoder.")}


def test_an_infinite_loss_ends_learning_with_an_error(
    network: pnp.Network, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(adapt, "LR", 1e30)
    with pytest.raises(pnp.DivergedError):
        adapt.learn(network, named(range(8)))
