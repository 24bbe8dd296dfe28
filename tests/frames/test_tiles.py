"""Frames refined tile by tile, against the whole frame and against what a seam would be."""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import nn

from pnpdepth_cli.core.split import Split
from pnpdepth_cli.errors import DivergedError
from pnpdepth_cli.frames import tiles
from pnpdepth_cli.frames.frame import Frame, Refined
from pnpdepth_cli.frames.refine import refine_frame
from pnpdepth_cli.frames.tiles import MIN_POINTS, OVERLAP, refine_tiled, tiles_of
from pnpdepth_cli.models.definition import ModelDefinition, Multiple
from pnpdepth_cli.models.network import Network
from pnpdepth_cli.points import SparsePoints
from pnpdepth_cli.settings import Settings

CPU = torch.device("cpu")
PLAIN = Settings(iterations=0)
SIDE = 64


class PixelByPixel(nn.Module):
    """Metres from the colour of each pixel alone: a tile sees what the whole frame sees."""

    def __init__(self) -> None:
        super().__init__()
        self.features, self.depth = nn.Conv2d(3, 4, 1), nn.Conv2d(4, 1, 1)

    def forward(self, rgb: torch.Tensor) -> torch.Tensor:
        depth: torch.Tensor = 2.0 + self.depth(torch.tanh(self.features(rgb)))
        return depth


class OneNumber(PixelByPixel):
    """One depth for all of what it is shown, so that tiles differ as much as they can."""

    def forward(self, rgb: torch.Tensor) -> torch.Tensor:
        z = self.features(rgb).mean(dim=(2, 3), keepdim=True)
        return (2.0 + z.sum(dim=1, keepdim=True)).expand(-1, 1, *rgb.shape[-2:])


def network(module: nn.Module) -> Network:
    definition = ModelDefinition(
        name="toy", input_kind="rgb", size=Multiple(1), build=type(module), layers=("features",)
    )
    return Network(definition=definition, module=module.eval(), checkpoint=None, device=CPU)


def frame_of(xy: list[tuple[int, int]], depth: list[float], size: tuple[int, int]) -> Frame:
    points = SparsePoints(
        xy=torch.tensor(xy, dtype=torch.float32), depth=torch.tensor(depth), size=size
    )
    rgb = np.random.default_rng(0).random((*size, 3), dtype=np.float32)
    return Frame(rgb=torch.from_numpy(rgb).permute(2, 0, 1).contiguous(), points=points)


def everywhere(size: tuple[int, int], step: int = 8) -> Frame:
    xy = [(x, y) for y in range(0, size[0], step) for x in range(0, size[1], step)]
    return frame_of(xy, [2.0 if x < size[1] // 2 else 2.4 for x, _ in xy], size)


def tiled(module: nn.Module, settings: Settings, one: Frame, propagation: str = "none") -> Refined:
    with Split(module, "features") as split:
        return refine_tiled(
            network(module), split, replace(settings, tile=SIDE), one, propagation=propagation
        )


@given(height=st.integers(1, 300), width=st.integers(1, 300), side=st.integers(16, 128))
def test_tiles_of_one_size_cover_the_frame_and_overlap_by_a_quarter(
    height: int, width: int, side: int
) -> None:
    tiles = tiles_of((height, width), side)
    assert {(tile.height, tile.width) for tile in tiles} == {(min(side, height), min(side, width))}
    covered = np.zeros((height, width), np.float32)
    for tile in tiles:
        assert 0 <= tile.top <= height - tile.height
        assert 0 <= tile.left <= width - tile.width
        weights = tile.weights((height, width))
        assert weights.min() > 0
        assert weights.max() <= 1
        part = tile.of(covered)
        part += weights
    assert covered.min() > 0.2
    lefts = sorted({tile.left for tile in tiles})
    assert all(b - a <= side * (1 - OVERLAP) + 1 for a, b in itertools.pairwise(lefts))


@given(
    st.lists(st.tuples(st.floats(-0.5, 149.25), st.floats(-0.5, 99.25)), min_size=1, max_size=30)
)
def test_every_point_is_in_the_tiles_that_contain_its_position(
    positions: list[tuple[float, float]],
) -> None:
    points = SparsePoints(
        xy=torch.tensor(positions), depth=torch.arange(1.0, len(positions) + 1), size=(100, 150)
    )
    depths = set()
    for tile in tiles_of((100, 150), SIDE):
        part = tile.points(points)
        assert part.size == (tile.height, tile.width)
        depths |= set(part.depth.tolist())
        back = part.xy + torch.tensor([float(tile.left), float(tile.top)])
        assert torch.allclose(back, points.xy[part.depth.long() - 1], atol=1e-4)
        assert bool((part.xy >= -0.5).all() and (part.xy < SIDE - 0.5).all())
    assert depths == set(points.depth.tolist())


def test_a_network_that_sees_pixels_alone_gives_the_same_in_tiles_as_in_one_piece() -> None:
    torch.manual_seed(0)
    module, one = PixelByPixel(), everywhere((100, 150))
    with Split(module, "features") as split:
        whole = refine_frame(network(module), split, PLAIN, one)
    refined = tiled(module, PLAIN, one)
    np.testing.assert_allclose(refined.after, whole.after, rtol=1e-5)
    np.testing.assert_allclose(refined.before, whole.before, rtol=1e-5)
    assert refined.notes[-1].startswith("tiles: 6 of 64×64 pixels")


def test_a_frame_no_larger_than_a_tile_is_refined_in_one_piece() -> None:
    torch.manual_seed(0)
    module, one = PixelByPixel(), everywhere((60, 64))
    settings = Settings(iterations=3)
    with Split(module, "features") as split:
        whole = refine_frame(network(module), split, settings, one)
    refined = tiled(module, settings, one)
    assert np.array_equal(refined.after, whole.after)
    assert refined.notes == whole.notes


def test_the_depths_of_tiles_run_into_each_other_without_a_step() -> None:
    torch.manual_seed(0)
    settings = Settings(iterations=60, lr=0.01)
    after = tiled(OneNumber(), settings, everywhere((64, 400))).after
    assert after.max() / after.min() > 1.15
    # the difference between two tiles is distributed evenly over their overlap
    overlap = OVERLAP * SIDE
    steps = np.abs(np.diff(after, axis=1)) / after[:, :-1]
    assert steps.max() < 1.1 * (after.max() / after.min() - 1) / overlap


def test_tiles_with_too_few_points_have_the_depth_of_the_whole_frame() -> None:
    torch.manual_seed(0)
    module = OneNumber()
    one = frame_of([(x, 10 + x) for x in range(10)], [3.0] * 10, (64, 300))
    refined = tiled(module, Settings(iterations=200, lr=0.01), one)
    assert np.unique(refined.after[:, 100:]).size <= 3  # one number, to the last bit of a division
    np.testing.assert_allclose(refined.after[:, 100:], refined.after[0, 299], rtol=1e-6)
    for count, left in ((10, 5), (MIN_POINTS, 5), (MIN_POINTS - 1, 6)):
        few = one.with_points(one.points.select(torch.arange(10) < count))
        assert tiled(module, PLAIN, few).notes[-1] == (
            f"tiles: 6 of 64×64 pixels, {left} of them left as in the whole frame,"
            " with fewer than 5 points"
        )


def test_a_divergence_in_one_tile_is_one_of_the_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    error, calls = DivergedError("in the first tile"), list[tuple[int, int]]()

    def diverging(*arguments: Any, **more: Any) -> Refined:
        calls.append(arguments[3].size)
        refined = refine_frame(*arguments, **more)
        return replace(refined, diverged=error) if len(calls) == 2 else refined

    monkeypatch.setattr(tiles, "refine_frame", diverging)
    refined = tiled(OneNumber(), PLAIN, everywhere((64, 150)))
    assert refined.diverged is error
    assert refined.notes[-1] == "tiles: 3 of 64×64 pixels"
    assert calls == [(27, 64), *[(64, 64)] * 3]  # the whole frame reduced, and three tiles


@pytest.mark.parametrize("unknown", ["before", "after"])
def test_where_a_tile_has_no_depth_that_of_the_whole_frame_stays(
    unknown: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def without_depth(*arguments: Any, **more: Any) -> Refined:
        refined, is_tile = refine_frame(*arguments, **more), arguments[3].size == (SIDE, SIDE)
        return replace(refined, **{unknown: 0 * refined.before}) if is_tile else refined

    monkeypatch.setattr(tiles, "refine_frame", without_depth)
    refined = tiled(OneNumber(), PLAIN, everywhere((64, 150)))
    for depth in (refined.before, refined.after):  # one number
        np.testing.assert_allclose(depth, depth[0, 0], rtol=1e-6)


def test_propagation_follows_once_over_all_tiles() -> None:
    torch.manual_seed(0)
    module, one = PixelByPixel(), everywhere((64, 150))
    refined = tiled(module, PLAIN, one, "gp")
    at_points = one.points.sample(torch.from_numpy(refined.after))
    assert float((at_points - one.points.depth).abs().mean()) < 0.05
    assert (
        float((one.points.sample(torch.from_numpy(refined.before)) - one.points.depth).abs().mean())
        > 0.2
    )
