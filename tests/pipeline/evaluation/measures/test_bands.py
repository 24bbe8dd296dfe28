"""Errors by area, by range, by distance to the points, and flicker, pixel by pixel."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from pnpdepth_cli.pipeline.evaluation.measures.area import area_errors
from pnpdepth_cli.pipeline.evaluation.measures.distance import distance_errors
from pnpdepth_cli.pipeline.evaluation.measures.flicker import flicker

from tests.pipeline.evaluation.measures.frames import random_frame

FRAME = random_frame(0)
PIXELS = [
    (y, x, float(FRAME.depth[y, x]), float(FRAME.gt[y, x]))
    for y, x in np.argwhere((FRAME.depth > 0) & (FRAME.gt > 0))
]


def test_errors_by_area_are_weighted_by_the_squared_depth() -> None:
    errors = area_errors(FRAME)
    area = sum(g * g for *_, g in PIXELS)
    assert errors["area_mae"] == pytest.approx(
        sum(g * g * abs(p - g) for *_, p, g in PIXELS) / area
    )
    assert errors["area_mre"] == pytest.approx(sum(g * abs(p - g) for *_, p, g in PIXELS) / area)


def test_bands_of_range_hold_their_lower_end() -> None:
    errors = area_errors(FRAME)
    near = [abs(p - g) for *_, p, g in PIXELS if 5 <= g < 10]
    assert errors["mae_5_10"] == pytest.approx(np.mean(near))
    assert math.isnan(errors["mae_40_80"])


def test_bands_of_distance_are_of_the_nearest_point() -> None:
    assert FRAME.sparse is not None
    points = np.argwhere(FRAME.sparse > 0)
    errors: dict[int, list[float]] = {0: [], 2: [], 8: [], 32: []}
    for y, x, p, g in PIXELS:
        apart = np.hypot(*(points - (y, x)).T).min()
        errors[max(low for low in errors if low <= apart)].append(abs(p - g))
    measured = distance_errors(FRAME)
    for low, listed in errors.items():
        value = measured[f"mae_from_{low}_px"]
        assert value == pytest.approx(np.mean(listed)) if listed else math.isnan(value)


def test_flicker_is_the_change_of_the_error_and_of_the_scale() -> None:
    before = random_frame(1)
    errors = flicker(replace(FRAME, previous=before))
    changes = [
        abs((p - g) - (float(before.depth[y, x]) - float(before.gt[y, x])))
        for y, x, p, g in PIXELS
        if before.depth[y, x] > 0 and before.gt[y, x] > 0
    ]
    assert errors["flicker"] == pytest.approx(np.mean(changes))
    scales = [
        np.median(f.depth[f.both].astype(float) / f.gt[f.both].astype(float))
        for f in (before, FRAME)
    ]
    assert errors["scale_flicker"] == pytest.approx(abs(np.log(scales[1] / scales[0])))
    assert all(math.isnan(value) for value in flicker(FRAME).values())
