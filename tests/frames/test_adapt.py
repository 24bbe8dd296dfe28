"""Weights that learn from frames in memory, `Refiner(adapt=…)`."""

from __future__ import annotations

import copy
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy.stats import ttest_rel

import pnpdepth_cli as pnp
from pnpdepth_cli.frames import adapt
from tests.frames.scenes import frame_in_memory

SETTINGS = pnp.Settings(iterations=0)
Pair = tuple[NDArray[np.float32], pnp.SparsePoints]


def pair(seed: int, count: int = 60) -> Pair:
    frame = frame_in_memory(count, seed)
    assert frame.rgb is not None
    return np.ascontiguousarray(frame.rgb.permute(1, 2, 0).numpy()), frame.points


FRAMES = [pair(seed) for seed in range(8)]


@pytest.fixture
def network(monkeypatch: pytest.MonkeyPatch) -> pnp.Network:
    steps = adapt.adaptation_settings.__kwdefaults__
    monkeypatch.setitem(steps, "steps", 12)
    return pnp.load_network("sparse2dense-tiny")


def test_learnt_weights_are_used_while_the_refiner_is_open(
    network: pnp.Network, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(adapt, "ttest_1samp", lambda *a, **k: SimpleNamespace(pvalue=0.01))
    before = copy.deepcopy(network.module.state_dict())
    own = pnp.refine(network, *FRAMES[0], SETTINGS)
    with pnp.Refiner(network, SETTINGS, adapt=FRAMES) as refiner:
        learnt = refiner.refine(*FRAMES[0])
        again = refiner.refine(*FRAMES[0])
    assert any("% loss at hidden points of 4 frames" in note for note in learnt.notes)
    assert np.array_equal(learnt.depth, again.depth)
    frame = frame_in_memory(seed=0)
    expected, _ = adapt.learnt(refiner.network, [frame_in_memory(seed=n) for n in range(8)], 0)
    assert expected is not None
    with expected.in_place(), torch.no_grad():
        by_hand = pnp.refine(network, *FRAMES[0], SETTINGS)
    assert np.array_equal(learnt.depth, by_hand.depth)
    residuals = [(frame.points.sample(torch.from_numpy(depth.depth)) - frame.points.depth).abs()
                 for depth in (own, learnt)]  # fmt: skip
    assert residuals[1].mean() < residuals[0].mean()
    assert all(torch.equal(network.module.state_dict()[name], before[name]) for name in before)
    after = pnp.refine(network, *FRAMES[0], SETTINGS)
    assert np.array_equal(after.depth, own.depth)


@pytest.mark.parametrize(
    ("frames", "p_value", "why"),
    [
        (FRAMES[:7], 0.01, "7 frames; at least 8 are needed"),
        (FRAMES, 0.2, "is not beyond chance"),
    ],
)
def test_without_proof_the_weights_of_the_network_stay(
    network: pnp.Network,
    monkeypatch: pytest.MonkeyPatch,
    frames: list[Pair],
    p_value: float,
    why: str,
) -> None:
    monkeypatch.setattr(adapt, "ttest_1samp", lambda *a, **k: SimpleNamespace(pvalue=p_value))
    own = pnp.refine(network, *FRAMES[0], SETTINGS)
    with pnp.Refiner(network, SETTINGS, adapt=frames) as refiner:
        refined = refiner.refine(*FRAMES[0])
    assert why in "\n".join(refined.notes)
    assert np.array_equal(refined.depth, own.depth)


def test_a_network_without_points_cannot_learn_from_them() -> None:
    with (
        pnp.Refiner(pnp.load_network("fcrn-tiny"), adapt=FRAMES) as refiner,
        pytest.raises(pnp.UsageError, match="sparse"),
    ):
        refiner.refine(*FRAMES[0])


def test_a_frame_to_learn_from_needs_two_points(network: pnp.Network) -> None:
    frames = [*FRAMES, pair(8, count=1)]
    with (
        pnp.Refiner(network, SETTINGS, adapt=frames) as refiner,
        pytest.raises(pnp.NoPointsError, match=r"frame 8: 1 points; hiding some needs 2"),
    ):
        refiner.refine(*FRAMES[0])


def test_frames_for_validation_are_looked_at_as_often_as_asked(network: pnp.Network) -> None:
    frames = [frame_in_memory(seed=seed) for seed in range(5)]
    with pnp.Refiner(network) as refiner:
        resolved = refiner.decide(frames[0]).network
    adaptation = adapt.Adaptation(
        resolved,
        adapt.adaptation_settings(resolved, frames[0]),
        {str(number): lambda frame=frame: frame for number, frame in enumerate(frames)},  # type: ignore[misc]
        validated=2,
        checks=2,
    )
    assert (adaptation.training, adaptation.validation) == ([0, 2, 4], [1, 3])
    losses = adaptation.run()
    assert sorted(losses) == [0, 8, 12]
    assert losses[adaptation.kept] == min(losses.values())
    best, first = adaptation._losses[adaptation.kept], adaptation._losses[0]
    expected = ttest_rel(np.log(best), np.log(first), alternative="less").pvalue
    assert adaptation.p_value() == pytest.approx(expected, rel=1e-9)
