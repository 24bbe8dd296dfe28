from __future__ import annotations

import math
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
import torch
from scipy.spatial.distance import cdist

from pnpdepth_cli.completion.gaussian_process import (
    Residuals,
    cielab,
    features_of,
    fit,
    leave_one_out,
    neighbourhoods,
    predict,
)
from pnpdepth_cli.points import SparsePoints
from tests.completion.residuals import SIZE, field


def covariance(field: Residuals, p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Of β₀ + β₁·u + f at features p and q; β₀ has variance 100 and β₁ has variance 1."""
    lengths = np.array([1, 1, field.depth_length, *[field.colour_length] * 3])[: p.shape[1]]
    return np.asarray(np.exp(-cdist(p / lengths, q / lengths)) + 100 + np.outer(p[:, 2], q[:, 2]))


def reference(
    field: Residuals, near: np.ndarray, queries: np.ndarray, noise: np.ndarray | float
) -> tuple[np.ndarray, np.ndarray]:
    """Mean and variance at features (M, 6) by the textbook, from the points with these numbers."""
    a = field.point_features.double().numpy()[near]
    k = covariance(field, queries, a)
    inverse = np.linalg.inv(covariance(field, a, a) + noise * np.eye(len(a)))
    variance = 1 + 100 + queries[:, 2] ** 2 - np.sum(k @ inverse * k, axis=1)
    return k @ inverse @ field.residual.numpy()[near], variance


def dense_reference(field: Residuals) -> np.ndarray:
    """The mean (H, W) from all points."""
    queries = field.features.flatten(1).T.double().numpy()
    mean, _ = reference(field, np.arange(len(field.points)), queries, field.noise)
    return mean.reshape(field.points.size)


@pytest.mark.parametrize("count", [1, 2, 7, 60])
@pytest.mark.parametrize("colour", [True, False])
def test_the_mean_is_that_of_the_textbook(count: int, colour: bool) -> None:
    residuals = field(count, colour=colour)
    assert np.allclose(predict(residuals).numpy(), dense_reference(residuals), atol=2e-4)


@pytest.mark.parametrize("size", [(60, 80), (40, 100)])
@pytest.mark.parametrize("count", [300, 900])
def test_the_mean_from_near_points_is_near_that_of_all(count: int, size: tuple[int, int]) -> None:
    residuals = field(count, size=size)
    off = np.abs(predict(residuals).numpy() - dense_reference(residuals))
    assert off.max() < 0.02
    assert off.mean() < 0.0025  # of residuals from 0.2 to 0.5


@pytest.mark.parametrize("count", [3, 400])
def test_at_a_position_the_mean_is_that_from_its_48_nearest_points(count: int) -> None:
    residuals = replace(field(count, size=(60, 80)), depth_length=2.5, colour_length=8.0)
    positions = torch.rand(20, 2, generator=torch.Generator().manual_seed(4)) * 59
    queries = SparsePoints(xy=positions, depth=torch.ones(20), size=(60, 80))
    features = torch.stack([queries.sample(feature) for feature in residuals.features], dim=1)
    expected = []
    for xy, query in zip(positions.numpy(), features.double().numpy(), strict=True):
        near = np.hypot(*(residuals.points.xy.numpy() - xy).T).argsort()[:48]
        expected += [reference(residuals, near, query[None], residuals.noise)[0].item()]
    assert np.allclose(predict(residuals, queries), expected, atol=2e-4)


@pytest.mark.parametrize("count", [12, 300])
def test_errors_and_variances_of_left_out_points_are_those_of_leaving_them_out(count: int) -> None:
    residuals = field(count)
    weight = torch.rand(count, generator=torch.Generator().manual_seed(5)).double()
    weight[5] = 0
    near = neighbourhoods(residuals, 128)
    error, variance = leave_one_out(residuals, near, weight)
    at = residuals.point_features.double().numpy()
    xy = residuals.points.xy.numpy()
    noise = residuals.noise / weight.clamp_min(1e-6).numpy() ** 2
    for row, numbers in enumerate(near.numpy()):
        apart = np.hypot(*(xy - xy[numbers[0]]).T)
        assert count == 12 or np.allclose(apart[numbers], np.sort(apart)[:48])
        for column in range(error.shape[1]):
            here = numbers[column]
            others = np.delete(numbers, column)
            mean, spread = reference(residuals, others, at[here][None], noise[others])
            expected = float(residuals.residual[here]) - mean, spread + residuals.noise
            assert np.allclose(expected[0], error[row, column], atol=1e-4)
            assert np.allclose(expected[1], variance[row, column], atol=1e-4)


@pytest.mark.parametrize("colour", [True, False])
def test_the_fit_has_the_smallest_error_of_all_lengths_and_then_of_all_noises(colour: bool) -> None:
    chosen = set()
    for seed in range(12):
        residuals = field(60, colour=colour, seed=seed)
        depth_length = (1.0, 2.5, 8.0, 25.0)[seed % 4]
        at = residuals.point_features.double().numpy()
        drawn = replace(residuals, depth_length=depth_length, colour_length=2.5, noise=1e-4)
        root = np.linalg.cholesky(covariance(drawn, at, at) + drawn.noise * np.eye(60))
        residual = root @ np.random.default_rng(seed).normal(size=60)

        def error(one: Residuals, at: np.ndarray = at, r: np.ndarray = residual) -> float:
            inverse = np.linalg.inv(covariance(one, at, at) + one.noise * np.eye(60))
            return float(np.abs(inverse @ r / np.diag(inverse)).mean())

        colours = (2.5, 8.0, 25.0) if colour else (2.5,)
        lengths = product((1.0, 2.5, 8.0, 25.0), colours)
        scaled = [replace(residuals, depth_length=d, colour_length=c) for d, c in lengths]
        best = min(scaled, key=error)
        best = min((replace(best, noise=n) for n in (1e-4, 1e-3, 1e-2, 1.0)), key=error)
        fitted = fit(replace(residuals, residual=torch.from_numpy(residual)))
        for name in ("depth_length", "colour_length", "noise"):
            assert getattr(fitted, name) == getattr(best, name)
        chosen.add(best.depth_length)
    assert len(chosen) >= 3
    assert [fit(few) is few for few in (field(4), field(5))] == [True, False]


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
def test_features_are_position_in_sides_and_depth_and_colour_in_deviations(colour: bool) -> None:
    log_depth = torch.tensor([[0.0, 2.0], [math.nan, 0.0], [2.0, 2.0]])
    rgb = torch.zeros(3, 3, 2)
    rgb[:, :, 1] = 1.0
    x, y, depth, *lab = features_of(log_depth, rgb if colour else None)
    assert torch.allclose(x, torch.tensor([[0, 1 / 3]]).expand(3, 2))
    assert torch.allclose(y, torch.tensor([[0], [1 / 3], [2 / 3]]).expand(3, 2))
    known = log_depth[log_depth.isfinite()]  # NaN reads as the mean
    std, mean = torch.std_mean(known, correction=0)
    assert torch.allclose(depth, ((log_depth - mean) / std).nan_to_num(0.0), rtol=2e-3)
    expected = torch.tensor([[[-1.0, 1.0]], [[0.0, 0.0]], [[0.0, 0.0]]]).expand(3, 3, 2)
    assert len(lab) == (3 if colour else 0)
    assert not lab or torch.allclose(torch.stack(lab), expected, atol=0.03)


def test_a_flat_prediction_and_image_have_no_features_but_the_position() -> None:
    flat = features_of(torch.full(SIZE, math.log(3.0)), torch.full((3, *SIZE), 0.5))
    assert flat[2:].abs().max() < 1e-3
    nearly = features_of(torch.tensor([[0.0, 1e-3]]), None)[2]  # a deviation of 5e-4, and 1e-3 more
    assert torch.allclose(nearly, torch.tensor([[-1 / 3, 1 / 3]]), rtol=1e-3)
