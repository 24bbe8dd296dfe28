from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from pnpdepth_cli.completion import triangles
from pnpdepth_cli.completion.triangles import (
    Floats,
    Numbers,
    Positions,
    barycentric,
    circles,
    cover,
    delaunay,
    delaunay_at,
)
from tests.completion.exact_triangles import (
    POINTS,
    QUARTERS,
    all_delaunay,
    doubled_area,
    holds,
    is_delaunay,
)

PIXELS = Positions(columns=np.arange(7.0), rows=np.arange(6.0))
PIXEL_XY = np.stack(np.meshgrid(PIXELS.columns, PIXELS.rows), axis=-1).reshape(-1, 2)


@settings(max_examples=60)
@given(POINTS)
def test_every_pixel_of_the_hull_is_in_a_triangle_whose_circle_is_empty(
    points: list[tuple[float, float]],
) -> None:
    xy = np.array(points)
    found = delaunay(xy)
    assert all(is_delaunay(xy, tuple(triangle)) for triangle in found)
    number = cover(xy[found], PIXELS)
    possible = all_delaunay(xy)
    for pixel, of_pixel in zip(PIXEL_XY, number, strict=True):
        if of_pixel >= 0:
            assert holds(xy, tuple(found[of_pixel]), pixel)
        else:
            assert not any(holds(xy, triangle, pixel) for triangle in possible)


@given(POINTS, st.randoms())
def test_neither_the_order_of_the_points_nor_points_elsewhere_change_the_triangles_of_a_place(
    points: list[tuple[float, float]], random: object
) -> None:
    xy = np.array(points)
    found = as_sets(xy, delaunay(xy))
    assert as_sets(xy[::-1], delaunay(xy[::-1])) == found
    elsewhere = np.concatenate([xy, xy + 1000.0])
    assert found - as_sets(elsewhere, delaunay(elsewhere)) <= on_hull(xy, found)


def as_sets(xy: Floats, numbers: Numbers) -> set[frozenset[tuple[float, ...]]]:
    return {frozenset(tuple(xy[corner]) for corner in triangle) for triangle in numbers.tolist()}


def on_hull(
    xy: Floats, found: set[frozenset[tuple[float, ...]]]
) -> set[frozenset[tuple[float, ...]]]:
    """The triangles whose circle reaches the points that are 1000 pixels away."""
    corners = np.array([sorted(triangle) for triangle in found]).reshape(-1, 3, 2)
    _, radius = circles(corners)
    return {triangle for triangle, size in zip(found, radius, strict=True) if size > 100}


@pytest.mark.parametrize("on_grid", [True, False])
@pytest.mark.parametrize("seed", range(3))
def test_the_triangles_at_a_few_positions_are_those_of_all_points(on_grid: bool, seed: int) -> None:
    rng = np.random.default_rng(seed)
    xy = np.unique((rng.random((4000, 2)) * (90, 70)).round(0 if on_grid else 6), axis=0)
    positions = rng.random((25, 2)) * (110, 90) - 10
    where, number = Positions.of(positions)
    few = delaunay_at(xy, positions)
    found = delaunay(xy)
    of_few, of_all = (cover(xy[corners], where)[number] for corners in (few, found))
    assert 5 < (of_few >= 0).sum() < 25
    assert np.array_equal(of_few >= 0, of_all >= 0)
    inside = of_all >= 0
    assert np.array_equal(np.sort(few[of_few[inside]]), np.sort(found[of_all[inside]]))
    assert len(few) <= 25 < len(found)


def test_where_its_trials_end_all_points_are_triangulated(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(triangles, "_TRIALS", 0)
    xy = np.random.default_rng(0).random((50, 2)) * 20
    assert np.array_equal(delaunay_at(xy, xy[:3]), delaunay(xy))


@given(POINTS, st.lists(st.tuples(QUARTERS, QUARTERS), max_size=8))
def test_positions_anywhere_and_repeated_are_in_the_triangles_that_hold_them(
    points: list[tuple[float, float]], anywhere: list[tuple[float, float]]
) -> None:
    xy = np.array(points)
    asked = np.array(anywhere * 2).reshape(-1, 2)
    where, number = Positions.of(asked)
    found = delaunay(xy)
    for position, of_position in zip(asked, cover(xy[found], where)[number], strict=True):
        held = [holds(xy, tuple(triangle), position) for triangle in found]
        assert held[of_position] if of_position >= 0 else not any(held)


@given(POINTS, st.tuples(QUARTERS, QUARTERS))
def test_barycentric_coordinates_give_the_position_back(
    points: list[tuple[float, float]], position: tuple[float, float]
) -> None:
    corners = np.array(points[:3])[None]
    assume(doubled_area(*corners[0]) != 0)
    shares = barycentric(corners, np.array([position]))
    assert shares.min() >= 0
    assert shares.sum() == pytest.approx(1)
    if holds(corners[0], (0, 1, 2), np.array(position)):
        assert (shares @ corners[0])[0] == pytest.approx(np.array(position), abs=1e-9)


@pytest.mark.parametrize(
    "points",
    [[(1, 1)], [(1, 1), (4, 2)], [(0, 0), (1, 1), (2, 2), (5, 5)], [(3, 0), (3, 7), (3, 9)]],
)
def test_fewer_than_three_points_and_points_on_one_line_have_no_triangle(
    points: list[tuple[float, float]],
) -> None:
    xy = np.array(points, float)
    assert delaunay(xy).shape == (0, 3)
    assert (cover(xy[delaunay(xy)], PIXELS) == -1).all()
