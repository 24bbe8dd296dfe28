from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.optimize import minimize_scalar

from pnpdepth_cli.completion.robust_line import fit_line, fit_location, mean_error

LIMITS = (0.01, 100.0)


def normal(count: int, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(count, generator=generator, dtype=torch.float64)


def test_a_location_is_the_minimum_of_the_loss() -> None:
    values = torch.cat([0.1 * normal(40), 2 + 0.1 * normal(10, 1)])
    location = fit_location(values)
    errors = (values - location).numpy()
    width = 2.385 * 1.4826 * np.median(np.abs(errors))
    loss = minimize_scalar(
        lambda at: np.log1p(((values.numpy() - at) / width) ** 2).sum(), bounds=(-1, 1)
    )
    assert location == pytest.approx(loss.x, abs=1e-3)
    assert abs(location) < 0.1 < float(values.mean())


@pytest.mark.parametrize("count", [3, 50, 20_000])
@pytest.mark.parametrize("space", ["depth", "inverse", "log"])
def test_a_line_is_found_from_few_and_from_many_points(space: str, count: int) -> None:
    x = 1 + 4 * torch.rand(count, generator=torch.Generator().manual_seed(1)).double()
    assert fit_line(x, 0.5 * x + 0.2, space, LIMITS) == pytest.approx((0.5, 0.2), rel=1e-4)


def test_two_fifths_of_points_of_another_line_do_not_count() -> None:
    x = 1 + 4 * torch.rand(500, generator=torch.Generator().manual_seed(1)).double()
    y = 0.5 * x + 0.2
    y[:200] = 4 - 0.6 * x[:200]
    assert fit_line(x, y, "depth", LIMITS) == pytest.approx((0.5, 0.2), abs=0.02)


def test_a_line_is_found_where_a_single_point_differs() -> None:
    x = torch.ones(1000).double()
    x[500] = 2
    assert fit_line(x, 3 * x, "depth", LIMITS) == pytest.approx((3, 0), abs=1e-3)


def test_in_the_mean_no_error_of_log_depth_counts_more_than_1() -> None:
    assert mean_error(torch.tensor([0.5, -5.0])) == pytest.approx(0.75)
