"""The calibration of a standard deviation by held-out residuals."""

from __future__ import annotations

import pytest
import torch

from pnpdepth_cli.auto.uncertainty import calibration


def test_calibration_brings_two_thirds_of_the_residuals_within_sigma() -> None:
    residual = torch.randn(2000, generator=torch.Generator().manual_seed(0)) * 3
    factor = calibration(residual, torch.ones(2000))
    assert float((residual.abs() <= factor).double().mean()) == pytest.approx(0.68, abs=1e-3)
    assert calibration(residual[:0], residual[:0]) == 1.0
