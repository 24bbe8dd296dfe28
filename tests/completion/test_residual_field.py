"""The features of pixels: position, predicted depth and colour."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from pnpdepth_cli.completion.residual_field import cielab, features_of

SIZE = (48, 64)


def test_grey_has_no_colour_and_white_is_the_lightest() -> None:
    grey = torch.linspace(0, 1, 11).expand(3, 1, 11)
    lightness, *colour = cielab(grey)[:, 0]
    assert torch.allclose(torch.stack(colour), torch.zeros(2, 11), atol=1e-3)
    assert float(lightness[-1]) == pytest.approx(100, abs=1e-3)
    assert bool((lightness[1:] > lightness[:-1]).all())


def test_pure_red_is_where_it_is_in_tables_of_cielab() -> None:
    lab: Tensor = cielab(torch.tensor([1.0, 0.0, 0.0])[:, None, None])[:, 0, 0]
    assert torch.allclose(lab, torch.tensor([53.24, 80.09, 67.20]), atol=0.05)


def test_features_of_a_flat_prediction_and_image_are_finite() -> None:
    features = torch.stack(
        features_of(torch.full(SIZE, math.log(3.0)), torch.full((3, *SIZE), 0.5))
    )
    assert bool(features.isfinite().all())
    assert float(features[2:].abs().max()) < 1e-3
