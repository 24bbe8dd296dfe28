"""Additional measures: pixel by pixel, by all pairs of points, and on planes and steps."""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.distance import cdist

from pnpdepth_cli.choices import MEASURE_GROUPS
from pnpdepth_cli.commands.evaluation.measures import MeasuredFrame, edges_of, normals_of

K = np.array([[50.0, 0, 20.0], [0, 60.0, 15.0], [0, 0, 1]])


def random_frame(seed: int) -> MeasuredFrame:
    """A frame of 30×40 pixels with holes in both depths, and sparse points."""
    rng = np.random.default_rng(seed)
    gt, depth = (rng.uniform(1, 30, (30, 40)) * (rng.random((30, 40)) > 0.2) for _ in range(2))
    return MeasuredFrame(
        depth=depth.astype(np.float32),
        gt=gt.astype(np.float32),
        intrinsics=K,
        sparse=(gt * (rng.random(gt.shape) < 0.03)).astype(np.float32),
    )


def values(name: str, frame: MeasuredFrame) -> dict[str, float]:
    group = MEASURE_GROUPS[name]
    keys = [measure.key for measure in group.measures]
    return dict(zip(keys, group.values(frame), strict=True))


FRAME = random_frame(0)
PIXELS = [
    (y, x, float(FRAME.depth[y, x]), float(FRAME.gt[y, x]))
    for y, x in np.argwhere((FRAME.depth > 0) & (FRAME.gt > 0))
]


def test_errors_by_area_are_weighted_by_the_squared_depth_and_bands_hold_their_lower_end() -> None:
    errors = values("area", FRAME)
    area = sum(g * g for *_, g in PIXELS)
    assert errors["area_mae"] == pytest.approx(
        sum(g * g * abs(p - g) for *_, p, g in PIXELS) / area
    )
    assert errors["area_mre"] == pytest.approx(sum(g * abs(p - g) for *_, p, g in PIXELS) / area)
    near = [abs(p - g) for *_, p, g in PIXELS if 5 <= g < 10]
    assert errors["mae_5_10"] == pytest.approx(np.mean(near))
    assert math.isnan(errors["mae_40_80"])
    at_10 = values("area", MeasuredFrame(depth=np.array([[11.0]]), gt=np.array([[10.0]])))
    assert at_10["mae_10_20"] == 1
    assert math.isnan(at_10["mae_5_10"])


def test_bands_of_distance_are_of_the_nearest_point() -> None:
    assert FRAME.sparse is not None
    points = np.argwhere(FRAME.sparse > 0)
    errors: dict[int, list[float]] = {0: [], 2: [], 8: [], 32: []}
    for y, x, p, g in PIXELS:
        apart = np.hypot(*(points - (y, x)).T).min()
        errors[max(low for low in errors if low <= apart)].append(abs(p - g))
    measured = values("distance", FRAME)
    for low, listed in errors.items():
        value = measured[f"mae_from_{low}_px"]
        assert value == pytest.approx(np.mean(listed)) if listed else math.isnan(value)
    without = replace(FRAME, sparse=np.zeros_like(FRAME.gt))
    assert np.isnan(list(values("distance", without).values())).all()


def test_flicker_is_the_change_of_the_error_and_of_the_scale() -> None:
    before = random_frame(1)
    errors = values("flicker", replace(FRAME, previous=before))
    changes = [
        abs((p - g) - (float(before.depth[y, x]) - float(before.gt[y, x])))
        for y, x, p, g in PIXELS
        if before.depth[y, x] > 0 and before.gt[y, x] > 0
    ]
    assert errors["flicker"] == pytest.approx(np.mean(changes))
    scales = [np.median(f.depth[f.both].astype(float) / f.gt[f.both]) for f in (before, FRAME)]
    assert errors["scale_flicker"] == pytest.approx(abs(np.log(scales[1] / scales[0])))
    assert all(math.isnan(value) for value in values("flicker", FRAME).values())


def test_chamfer_and_f_score_are_those_of_all_pairs() -> None:
    y, x = np.nonzero(FRAME.both)
    clouds = []
    for depth in (FRAME.depth, FRAME.gt):
        z = depth[y, x].astype(float)
        clouds.append(np.stack([z * (x - 20) / 50, z * (y - 15) / 60, z], axis=1))
    apart = cdist(*clouds)
    accuracy, completeness = apart.min(axis=1), apart.min(axis=0)
    precision, recall = ((d < 0.1).mean() for d in (accuracy, completeness))
    errors = values("cloud", FRAME)
    assert errors["chamfer"] == pytest.approx((accuracy.mean() + completeness.mean()) / 2)
    assert errors["f_score"] == pytest.approx(2 * precision * recall / (precision + recall))
    assert values("cloud", replace(FRAME, depth=FRAME.gt)) == {"chamfer": 0, "f_score": 1}
    assert values("cloud", replace(FRAME, depth=FRAME.gt + 50))["f_score"] == 0
    nothing = replace(FRAME, depth=np.zeros_like(FRAME.gt))
    assert np.isnan(list(values("cloud", nothing).values())).all()


def step(column: int) -> np.ndarray:
    depth = np.full((40, 60), 2, np.float32)
    depth[:, column:] = 5
    return depth


def edge_errors(depth: np.ndarray, gt: np.ndarray) -> tuple[float, ...]:
    return tuple(values("edges", MeasuredFrame(depth=depth, gt=gt)).values())


@pytest.mark.parametrize(
    ("column", "error"), [(30, 0), (31, 1), (34, 4), (39, 9), (50, 10), (60, 10)]
)
def test_a_shifted_step_is_as_far_as_it_is_shifted_up_to_ten_pixels(
    column: int, error: int
) -> None:
    assert edge_errors(step(column), step(30)) == pytest.approx((error, error))
    far = edge_errors(18 + step(column), 18 + step(30))
    assert far == pytest.approx((error, error))


def test_an_extra_edge_costs_completeness_alone_and_holes_make_none() -> None:
    extra = step(30)
    extra[:, 50:] = 8
    accuracy, completeness = edge_errors(extra, step(30))
    assert accuracy == 0
    assert completeness == pytest.approx(10 / 3, rel=0.05)  # (0 + 10 + 0) / 3 edges
    holes = step(30)
    holes[10:20, 5:15] = 0
    assert edge_errors(holes, step(30)) == (0, 0)
    holes[:, 28:38] = 0  # where the edge was is not known
    assert edge_errors(holes, step(30)) == (10, 10)
    assert np.isnan(edge_errors(np.zeros_like(holes), step(30))).all()
    rough = step(30)
    rough[:, :20] += np.random.default_rng(0).uniform(0, 0.02, (40, 20)).astype(np.float32)
    assert edge_errors(rough, step(30)) == (0, 0)
    sparse = np.where(np.random.default_rng(0).random((40, 60)) < 0.1, step(30), 0)
    assert np.isnan(edge_errors(step(30), sparse.astype(np.float32))).all()
    assert np.isnan(edge_errors(step(30), np.full((40, 60), 2, np.float32))).all()


def test_boundary_errors_are_ibims_formulas_over_all_pairs_of_edge_pixels() -> None:
    rng = np.random.default_rng(0)
    noise = (cv2.GaussianBlur(rng.uniform(size=(50, 70)), (0, 0), 3) for _ in range(2))
    gt, depth = (np.where(n > 0.5, 4, 2).astype(np.float32) for n in noise)
    own, true = (np.argwhere(edges_of(each)) for each in (depth, gt))
    apart = cdist(own, true)
    to_gt, to_own = apart.min(axis=1), apart.min(axis=0)
    near = to_gt[to_gt < 10]
    both = np.minimum(to_gt, 10).sum() + np.minimum(to_own, 10).sum()
    expected = near.mean(), both / (len(own) + len(true))
    assert edge_errors(depth, gt) == pytest.approx(expected, rel=1e-5)


def tilted(degrees: float) -> tuple[float, float, float]:
    angle = np.radians(degrees)
    return (float(np.sin(angle)), 0.0, float(np.cos(angle)))


def plane(degrees: float) -> np.ndarray:
    """The depth (48, 72) of a plane at 5 m, tilted about y."""
    y, x = np.mgrid[:48, :72]
    rays = np.stack([(x - 20) / 50, (y - 15) / 60, np.ones(x.shape)], axis=-1)
    return np.asarray(5 / (rays @ np.array(tilted(degrees))), np.float32)


def surface(depth: np.ndarray, gt: np.ndarray) -> dict[str, float]:
    return values("normals", MeasuredFrame(depth=depth, gt=gt, intrinsics=K))


@pytest.mark.parametrize("degrees", [5, 20, 40])
def test_the_error_of_a_tilted_plane_is_its_tilt(degrees: float) -> None:
    measured = surface(plane(degrees), plane(0))
    assert measured["normal_angle"] == pytest.approx(degrees, abs=1e-3)
    assert measured["plane_angle"] == pytest.approx(degrees, abs=1e-3)
    assert measured["planarity"] == pytest.approx(0, abs=1e-5)
    assert (measured["normal_11"], measured["normal_30"]) == (degrees < 11.25, degrees < 30)
    depth = plane(degrees)
    depth[20, 30] = 0  # it and its four neighbours have no normal
    frame = MeasuredFrame(depth=depth, gt=plane(degrees), intrinsics=K)
    normals, known = normals_of(frame.points(frame.gt), frame.both)
    assert known.sum() == 46 * 70 - 5
    assert np.abs(normals[known] @ np.array(tilted(degrees))) == pytest.approx(1, abs=1e-6)


def test_planarity_is_the_deviation_from_the_least_squares_plane() -> None:
    gt = plane(0)
    noisy = (gt + np.random.default_rng(0).normal(0, 0.05, gt.shape)).astype(np.float32)
    points = MeasuredFrame(depth=noisy, gt=gt, intrinsics=K).points(noisy)
    spreads = []
    for y in (0, 24):
        for x in (0, 24, 48):
            tile = points[y : y + 24, x : x + 24].reshape(-1, 3)
            singular = np.linalg.svd(tile - tile.mean(axis=0), compute_uv=False)
            spreads.append(singular[-1] / np.sqrt(len(tile)))
    assert surface(noisy, gt)["planarity"] == pytest.approx(np.mean(spreads), rel=1e-6)
    assert math.isnan(surface(gt, noisy)["planarity"])  # of tiles that are no planes
    gt[::2] = gt[:, ::2] = 0  # no pixel has neighbours, no tile is half known
    assert np.isnan(list(surface(plane(0), gt).values())).all()
