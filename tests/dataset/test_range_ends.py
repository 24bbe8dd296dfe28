"""Both ends of the range of depths: the sky, unknown depth as a constant, clips."""

from __future__ import annotations

import re

import numpy as np
import pytest

from pnpdepth_cli.dataset.plausible import plausible_map
from pnpdepth_cli.dataset.range_ends import far_values
from pnpdepth_cli.io.formats import Reading

RNG = np.random.default_rng(0)
MAP = RNG.uniform(1, 60, (40, 50)).astype(np.float32)
ROOM = RNG.uniform(0.5, 8, (40, 50)).astype(np.float32)
FLOAT = Reading("PFM", None, False)


def with_plane(far: float, mixed: int = 0) -> np.ndarray:
    depth = MAP.copy()
    depth[:4] = far
    depth[4, :mixed] = 0.4 * far + 0.6 * 20  # edges that a renderer mixed
    return depth


@pytest.mark.parametrize(
    ("depth", "unknown"),
    [
        *((with_plane(far), 200) for far in (1e10, 65504, 10000, 1000, 255)),
        *((with_plane(far, mixed=10), 210) for far in (1e10, 65504, 10000)),
        (np.where(np.arange(50) < 10, 4.0, 1.5) * np.ones((40, 1)), 0),  # a wall behind a box
        (np.round(MAP / 10, 2), 0),  # a room in whole centimetres
        (np.where(MAP > 59.9, 90, MAP), 0),  # few far points, all alike
    ],
)
def test_a_far_plane_is_unknown_but_no_surface_is(depth: np.ndarray, unknown: int) -> None:
    values, notes = plausible_map(depth.astype(np.float32), FLOAT, "gt", "--gt-scale", None)
    expected = depth.astype(np.float32)
    expected.ravel()[:unknown] = 0
    np.testing.assert_array_equal(values, expected)
    assert bool(notes) == bool(unknown)


@pytest.mark.parametrize(
    ("rest", "far", "unknown"),
    [
        (np.linspace(0, 20, 991)[1:], [40.1] * 10, 10),
        (np.linspace(0, 20, 991)[1:], [39.9] * 10, 0),  # a hall
        (np.linspace(0, 30, 991)[1:], [45.1] * 10, 10),
        (np.linspace(0, 30, 991)[1:], [44.9] * 10, 0),  # less than 1.5 times the rest
        (np.linspace(0, 30, 997)[1:], [45.1] * 4, 0),  # of 1,000, less than 0.5 %
        (np.linspace(0, 20, 1000)[1:], [10_100.0], 1),
        (np.linspace(0, 20, 1000)[1:], [9_900.0], 0),  # less than 1000 times the median
        (np.full(50, 2.0), [1e30], 1),
        (np.full(1, 2.0), [1e30], 0),
    ],
)
def test_depths_beyond_the_limit_are_unknown_and_counted(
    rest: np.ndarray, far: list[float], unknown: int
) -> None:
    depth = np.append(rest, far)
    found, notes = far_values(depth)
    assert np.flatnonzero(found).tolist() == list(range(len(depth) - unknown, len(depth)))
    if unknown:
        assert [f"{unknown} of {len(depth):,} " in note for note in notes] == [True]


@pytest.mark.parametrize("constant", [1e-6, 1e-3, 1 / 256, 0.01, 0.1])
@pytest.mark.parametrize("share", [0.01, 0.3, 0.95])
def test_unknown_depth_as_a_small_constant_is_unknown(constant: float, share: float) -> None:
    depth = np.where(RNG.uniform(size=ROOM.shape) < share, np.float32(constant), ROOM)
    far, (note,) = far_values(depth.ravel())
    np.testing.assert_array_equal(far, (depth == np.float32(constant)).ravel())
    assert "unknown" in note


@pytest.mark.parametrize(
    "depth",
    [
        np.maximum(ROOM, 0.6),  # a least range where surfaces are, which a line tells
        0.1 * ROOM,  # an endoscope
        np.round(0.1 * ROOM, 2),
        np.where(np.arange(50) < 10, 0.1, 0.3) * np.ones((40, 1)),
    ],
)
def test_no_near_surface_is_taken_for_unknown(depth: np.ndarray) -> None:
    assert not far_values(depth.ravel().astype(np.float32))[0].any()


@pytest.mark.parametrize(
    ("sky", "room", "kept"),
    [
        (400 * np.ones(300), 8.0, 0),
        (400 * RNG.uniform(0.02, 1, 60), 8.0, 60),  # and mixed with the room at its edges
        (400 * (1 + 0.001 * RNG.normal(size=300)), 8.0, 0),  # with noise
        (np.repeat([400.0, 4000.0], 150), 8.0, 0),  # two constants
    ],
)
def test_a_sky_is_unknown_however_it_was_made(sky: np.ndarray, room: float, kept: int) -> None:
    depth = np.concatenate([ROOM.ravel(), np.full(200, 400.0) if kept else [], sky])
    unknown, notes = far_values(depth.astype(np.float32))
    assert not unknown[: ROOM.size].any()
    assert depth[~unknown].max() < 10 * room
    assert len(notes) == 1


@pytest.mark.parametrize(
    "depth",
    [np.minimum(MAP, 50), np.where(MAP > 55, 61, MAP), np.maximum(ROOM, 1), np.minimum(ROOM, 7)],
)
def test_a_clip_where_surfaces_are_is_told_and_kept(depth: np.ndarray) -> None:
    values, (note,) = plausible_map(depth.astype(np.float32), FLOAT, "gt", "--gt-scale", None)
    np.testing.assert_array_equal(values, depth.astype(np.float32))
    assert note.startswith("warning: gt: ")


def test_what_is_said_of_the_other_depths_is_true_of_98_per_cent_of_them() -> None:
    rng = np.random.default_rng(0)
    rooms = rng.uniform(1, 5, 900)
    corridor = rng.uniform(10, 20, 80)
    edges_of_the_sky = np.linspace(31, 44, 10)
    depth = np.concatenate([rooms, corridor, edges_of_the_sky, np.full(20, 45.0)])
    is_no_depth, (note,) = far_values(depth)
    assert is_no_depth[-30:].all()
    said = re.search(r"98 % of the others are at most ([\d.]+) m", note)
    assert said is not None
    others = depth[~is_no_depth]
    assert np.mean(others <= float(said[1]) + 0.05) == pytest.approx(0.98, abs=0.01)
