"""Normals and planarity of planes whose geometry is known."""

from __future__ import annotations

import numpy as np
import pytest
from pnpdepth_cli.pipeline.evaluation.measured_frame import MeasuredFrame
from pnpdepth_cli.pipeline.evaluation.measures.normals import normals_of, surface_errors

from tests.pipeline.evaluation.measures.frames import K, plane


def tilted(degrees: float) -> tuple[float, float, float]:
    angle = np.radians(degrees)
    return (float(np.sin(angle)), 0.0, float(np.cos(angle)))


def errors(depth: np.ndarray, gt: np.ndarray) -> dict[str, float]:
    return surface_errors(MeasuredFrame(depth=depth, gt=gt, intrinsics=K))


def test_normals_of_a_plane_are_the_planes() -> None:
    frame = MeasuredFrame(depth=plane(tilted(20), 5), gt=plane(tilted(20), 5), intrinsics=K)
    normals, known = normals_of(frame.points(frame.gt), frame.both)
    assert known.sum() == 46 * 70
    assert np.abs(normals[known] @ np.array(tilted(20))) == pytest.approx(1, abs=1e-6)


@pytest.mark.parametrize("degrees", [5, 20, 40])
def test_the_error_of_a_tilted_plane_is_its_tilt(degrees: float) -> None:
    measured = errors(plane(tilted(degrees), 5), plane(tilted(0), 5))
    assert measured["normal_angle"] == pytest.approx(degrees, abs=1e-3)
    assert measured["plane_angle"] == pytest.approx(degrees, abs=1e-3)
    assert measured["planarity"] == pytest.approx(0, abs=1e-5)
    assert (measured["normal_11"], measured["normal_30"]) == (degrees < 11.25, degrees < 30)


def test_planarity_is_the_deviation_from_the_least_squares_plane() -> None:
    gt = plane(tilted(0), 5)
    noisy = (gt + np.random.default_rng(0).normal(0, 0.05, gt.shape)).astype(np.float32)
    points = MeasuredFrame(depth=noisy, gt=gt, intrinsics=K).points(noisy)
    spreads = []
    for y in (0, 24):
        for x in (0, 24, 48):
            tile = points[y : y + 24, x : x + 24].reshape(-1, 3)
            singular = np.linalg.svd(tile - tile.mean(axis=0), compute_uv=False)
            spreads.append(singular[-1] / np.sqrt(len(tile)))
    assert errors(noisy, gt)["planarity"] == pytest.approx(np.mean(spreads), rel=1e-6)


def test_a_frame_without_neighbouring_depths_has_no_normals() -> None:
    gt = plane(tilted(0), 5)
    gt[::2] = 0
    gt[:, ::2] = 0
    assert np.isnan(list(errors(plane(tilted(0), 5), gt).values())).all()
