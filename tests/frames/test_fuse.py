"""The weights of the experts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from pnpdepth_cli.frames import fuse
from pnpdepth_cli.frames.fuse import fit_weights
from tests.frames.scenes import network_expert, split_of


def test_weights_are_those_that_predict_the_validation_points_best_beside_the_prior() -> None:
    rng = np.random.default_rng(3)
    truth = torch.from_numpy(rng.uniform(1, 4, 300))
    noisy = [truth * torch.from_numpy(np.exp(s * rng.normal(size=300))) for s in (0.1, 0.2, 0.3)]
    experts = [
        network_expert(str(k), at, w)
        for k, (at, w) in enumerate(zip(noisy, (0.2, 0.3, 0.5), strict=True))
    ]
    shares = rng.uniform(0.1, 1, 300)
    split = replace(split_of(truth), weights=torch.from_numpy(shares))
    found = np.array(list(fit_weights(experts, split).values()))
    logs = np.stack([at.log().numpy() for at in noisy], axis=1)
    prior = np.array([0.2, 0.3, 0.5])
    y = truth.log().numpy()
    first = y - logs @ prior
    scale = 1.25 * np.average(np.abs(first), weights=shares)

    def loss(weights: np.ndarray) -> float:
        size = np.abs(y - logs @ weights)
        huber = shares @ np.where(size < scale, size**2, 2 * scale * size - scale**2)
        return float(huber + fuse.STRENGTH * scale**2 * ((weights - prior) ** 2).sum())

    for _ in range(200):  # no other weights near by, or anywhere, are better
        other = np.abs(found + rng.choice([0.01, 0.3]) * rng.normal(size=3))
        assert loss(other / other.sum()) > loss(found) - 1e-6


def test_an_expert_without_prior_weight_or_prediction_decides_nothing() -> None:
    depth = torch.full((50,), 2.0)
    none = network_expert("none", depth, weight=0.0)
    exact = network_expert("exact", depth * 1.001)
    weights = fit_weights([none, exact, network_expert("poor", depth * 1.2)], split_of(depth))
    assert weights["none"] == 0
    blank = fit_weights(
        [network_expert("a", depth * 0), network_expert("b", depth * 0)], split_of(depth)
    )
    assert blank == {"a": pytest.approx(0.5), "b": pytest.approx(0.5)}
