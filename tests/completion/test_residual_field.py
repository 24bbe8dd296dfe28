"""The features of pixels: position, predicted depth and colour."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from pnpdepth_cli.completion.residual_field import cielab, features_of

SIZE = (48, 64)


def test_colours_are_those_of_the_formula_from_the_primaries_of_srgb() -> None:
    rgb = np.random.default_rng(0).uniform(0, 1, (3, 30, 4)) ** np.array([1, 2, 4, 8])
    # CIE 1931 chromaticities of the primaries, as columns, and D65 (IEC 61966-2-1).
    primaries = np.array([[0.64, 0.30, 0.15], [0.33, 0.60, 0.06], [0.03, 0.10, 0.79]])
    white = np.array([0.95047, 1.0, 1.08883])
    matrix = primaries * np.linalg.solve(primaries, white)
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    t = np.einsum("ij,jhw->ihw", matrix, linear) / white[:, None, None]
    delta = 6 / 29
    x, y, z = np.where(t > delta**3, np.cbrt(t), t / (3 * delta**2) + 4 / 29)
    expected = np.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)])
    assert float(t.min()) < 0.5 * delta**3
    assert np.allclose(cielab(torch.from_numpy(rgb)).numpy(), expected, atol=0.01)


@pytest.mark.parametrize("colour", [True, False])
def test_features_are_the_position_in_the_longer_side_and_depth_and_colour_in_deviations(
    colour: bool,
) -> None:
    log_depth = torch.tensor([[0.0, 2.0], [math.nan, 0.0], [2.0, 2.0]])
    rgb = torch.zeros(3, 3, 2)
    rgb[:, :, 1] = 1.0
    x, y, depth, *lab = features_of(log_depth, rgb if colour else None)
    assert torch.allclose(x, torch.tensor([[0, 1 / 3]]).expand(3, 2))
    assert torch.allclose(y, torch.tensor([[0], [1 / 3], [2 / 3]]).expand(3, 2))
    known = log_depth[log_depth.isfinite()]  # NaN reads as the mean
    std, mean = torch.std_mean(known, correction=0)
    assert torch.allclose(depth, ((log_depth - mean) / std).nan_to_num(0.0), rtol=2e-3)
    assert len(lab) == (3 if colour else 0)
    if colour:
        lightness = torch.tensor([-1.0, 1.0]).expand(3, 2)
        assert torch.allclose(lab[0], lightness, atol=0.03)
        assert torch.allclose(torch.stack(lab[1:]), torch.zeros(2, 3, 2), atol=1e-3)


def test_a_flat_prediction_and_image_have_no_features_but_the_position() -> None:
    flat = features_of(torch.full(SIZE, math.log(3.0)), torch.full((3, *SIZE), 0.5))
    assert torch.stack(flat[2:]).abs().max() < 1e-3
    nearly = features_of(torch.tensor([[0.0, 1e-3]]), None)[2]  # a deviation of 5e-4, and 1e-3 more
    assert torch.allclose(nearly, torch.tensor([[-1 / 3, 1 / 3]]), rtol=1e-3)
