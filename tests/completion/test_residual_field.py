"""The features of pixels: position, predicted depth and colour."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from pnpdepth_cli.completion.residual_field import cielab, features_of

SIZE = (48, 64)


@pytest.mark.parametrize(
    ("rgb", "expected"),
    [((1.0, 0.0, 0.0), (53.24, 80.09, 67.20)), ((0.02, 0.02, 0.02), (1.40, 0, 0))],
)
def test_colours_are_where_they_are_in_tables_of_cielab(
    rgb: tuple[float, ...], expected: tuple[float, ...]
) -> None:
    lab: Tensor = cielab(torch.tensor(rgb)[:, None, None])[:, 0, 0]
    assert torch.allclose(lab, torch.tensor(expected), atol=0.05)


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
