"""Boundary F1 and the errors by depth against plain numpy, from the formulas of the papers."""

from __future__ import annotations

from itertools import product
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.integrate import trapezoid

from pnpdepth_cli import choices
from pnpdepth_cli.io.depth import read_depth
from pnpdepth_cli.measures import MEASURES, OF_SIGMA, by_depth, frame_means, score
from tests.plain_scores import brute

SAMPLES = Path(__file__).parents[1] / "samples"
MAIN = ("rmse", "mae", "mre", "delta1")
LIMITS = np.linspace(1.05, 1.25, 10)


def depth_pro(predicted: np.ndarray, truth: np.ndarray) -> float:
    """Equations 2 to 5 of Depth Pro, over the pairs whose true depths are known."""
    scores = []
    for limit in LIMITS:
        precision, recall = [], []
        for turns in range(4):  # the four directions
            p, g = (np.rot90(image, turns) for image in (predicted, truth))
            known = (g[:, :-1] > 0) & (g[:, 1:] > 0)
            own, true = (
                known & (depths[:, :-1] > 0) & (depths[:, 1:] > limit * depths[:, :-1])
                for depths in (p, g)
            )
            precision.append((own & true).sum() / max(own.sum(), 1))
            recall.append((own & true).sum() / max(true.sum(), 1))
        p = np.mean(precision)
        r = np.mean(recall)
        scores.append(2 * p * r / (p + r) if p + r else 0.0)
    return float(np.average(scores, weights=LIMITS))


def moge(predicted: np.ndarray, truth: np.ndarray, radius: int) -> float:
    """The boundary metric of MoGe: all pixels within the radius, counted together."""
    counts = np.zeros((len(LIMITS), 3))
    (height, width) = truth.shape
    for y, x in product(range(-radius, radius + 1), repeat=2):
        if x * x + y * y > radius * radius:
            continue
        inner = np.s_[radius : height - radius, radius : width - radius]
        moved = np.s_[radius + y : height - radius + y, radius + x : width - radius + x]
        known = (truth[inner] > 0) & (truth[moved] > 0)
        for row, limit in zip(counts, LIMITS, strict=True):
            own, true = (
                known & (depths[inner] > 0) & (depths[moved] > limit * depths[inner])
                for depths in (predicted, truth)
            )
            row += (own & true).sum(), own.sum(), true.sum()
    hits, own, true = counts.T
    f1 = 2 * hits / np.maximum(own + true, 1)
    return float(np.average(f1, weights=LIMITS - 1))


def frames() -> list[tuple[np.ndarray, np.ndarray]]:
    """Real ground truth, and what a smooth and a noisy network would say of it."""
    rng = np.random.default_rng(0)
    found = []
    for name in ("indoor", "street"):
        truth = read_depth(SAMPLES / name / "gt.png").values[::4, ::4]
        noisy = truth * rng.lognormal(0, 0.05, truth.shape).astype(np.float32)
        shifted = np.roll(truth, 1, axis=1)
        shifted[rng.random(truth.shape) < 0.01] = 0  # holes in the prediction
        found += [(noisy, truth), (shifted, truth)]
    return found


def of(key: str, depth: np.ndarray, truth: np.ndarray) -> float:
    return choices.MEASURES[key].formula(depth, truth)


def test_boundary_f1_is_that_of_depth_pro_and_of_moge() -> None:
    for depth, truth in frames():
        wide = depth.astype(np.float64), truth.astype(np.float64)
        assert of("boundary_f1", depth, truth) == pytest.approx(depth_pro(*wide), abs=1e-9)
        for radius in (1, 2, 3):
            found = of(f"boundary_f1_{radius}px", depth, truth)
            assert found == pytest.approx(moge(*wide, radius), abs=1e-9)
            assert 0 <= found < 1


def test_a_step_in_its_place_scores_one_and_a_shifted_or_a_missing_one_nothing() -> None:
    step = np.where(np.arange(20) < 10, np.float32(2), np.float32(3)) + np.zeros((9, 1), np.float32)
    # Depth Pro: the step is seen in one of four directions, and the others count as missed
    assert [of(key, step, step) for key in choices.MEASURES if key.startswith("boundary")] == [
        0.25,
        1,
        1,
        1,
    ]
    assert of("boundary_f1_1px", np.roll(step, 1, axis=1)[:, 1:], step[:, 1:]) == 0
    assert of("boundary_f1_1px", np.ones_like(step), step) == 0
    lone = np.where(np.arange(20) % 5 == 0, step, 0)
    assert np.isnan(of("boundary_f1", step, np.where(np.arange(9)[:, None] % 5, 0, lone)))


@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # the mean of nothing
def test_errors_by_depth_are_those_of_the_pixels_of_each_part() -> None:
    for depth, truth in frames():
        measures = by_depth(MEASURES, 3.0, 12.0)
        tensors = (torch.from_numpy(array.copy()) for array in (depth, truth))
        found = list(score(*tensors, measures).values())
        parts = (truth < 3, (truth >= 3) & (truth < 12), truth >= 12)
        expected = [
            brute(depth, np.where(region, truth, 0))[key] for region in parts for key in MAIN
        ]
        assert found == pytest.approx(expected, abs=1e-9, nan_ok=True)
    keys = [f"{key}_{region}" for region in ("near", "middle", "far") for key in MAIN]
    assert [measure.key for measure in measures] == keys


def test_a_mean_is_over_the_frames_that_have_the_value() -> None:
    frames = [{"mae": 1.0, "rmse": 4.0}, {"mae": 2.0, "rmse": np.nan}, {"mae": None, "mre": None}]
    assert frame_means(frames) == {"mae": 1.5, "rmse": 4.0, "mre": None}
    assert frame_means([]) == {}


def sigma_measures(*images: np.ndarray) -> list[float]:
    """The fractions within one and two σ, and AUSE, of prediction, ground truth and σ."""
    images = tuple(image.astype(np.float32) for image in images)
    return [measure.formula(*images) for measure in OF_SIGMA if measure.formula]


def test_a_right_deviation_is_calibrated_and_the_sparsification_error_is_by_definition() -> None:
    rng = np.random.default_rng(0)
    gt = rng.uniform(2, 6, (300, 300))
    sigma = rng.uniform(0.02, 0.2, (300, 300))
    depth = gt + sigma * rng.normal(size=gt.shape)
    right, half = (sigma_measures(depth, gt, sigma * factor) for factor in (1, 0.5))
    assert [*right[:2], half[0]] == pytest.approx([0.683, 0.954, 0.383], abs=0.01)

    gt = np.full((1, 20), 10.0)
    error = np.arange(1.0, 21)[None]
    worst = sigma_measures(gt + error, gt, error[:, ::-1])[2]
    by_sigma = [error[0, n:].mean() for n in range(20)]
    by_error = [error[0, : 20 - n].mean() for n in range(20)]
    area = trapezoid(np.subtract(by_sigma, by_error), np.arange(20) / 20)
    assert worst == pytest.approx(area / error.mean())
    assert sigma_measures(gt + error, gt, error)[2] == 0


def test_a_pixel_without_sigma_prediction_or_ground_truth_is_in_no_measure_of_sigma() -> None:
    gt, depth, sigma = np.array(
        [[[0.5, 10, 10, 10, 0]], [[1.5, 0, 12, 13, 8]], [[1, 1, 0, 1.5, 1]]]
    )
    assert sigma_measures(depth, gt, sigma)[:2] == [0.5, 1.0]  # errors of 1 and 3 m
    assert np.isnan(sigma_measures(depth, gt, np.zeros_like(gt))).all()
