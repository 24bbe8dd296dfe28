"""A network's output in metres, and the warnings where it and the points do not go together."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from pnpdepth_cli.choices import OutputKind, OutputScale
from pnpdepth_cli.models.aligned_depth import AlignedDepth, align_output
from pnpdepth_cli.points import SparsePoints
from tests.models.definitions import network


def frame_of_depth(count: int) -> tuple[Tensor, SparsePoints]:
    """Depth (1, 1, 40, 40) in metres, and some points of it."""
    generator = torch.Generator().manual_seed(0)
    depth = torch.exp(torch.rand(1, 1, 40, 40, generator=generator) * 2)
    xy = torch.randint(0, 40, (count, 2), generator=generator)
    points = SparsePoints(xy=xy.float(), depth=depth[0, 0, xy[:, 1], xy[:, 0]], size=(40, 40))
    return depth, points


@pytest.mark.parametrize(
    ("of_depth", "of_noise", "count", "said"),
    [(0.0, 1.0, 200, True), (0.3, 0.0, 200, False), (0.3, 0.5, 200, False), (0.0, 1.0, 10, False)],
)
def test_a_blind_network_is_named(of_depth: float, of_noise: float, count: int, said: bool) -> None:
    depth, points = frame_of_depth(count)
    unrelated = torch.rand(1, 1, 40, 40, generator=torch.Generator().manual_seed(1))
    reader = AlignedDepth(network(output_scale="affine"), points, "auto")
    reader(of_depth * depth + of_noise * unrelated)
    assert any("network 'n' says nothing about" in note for note in reader.notes) == said


def test_a_network_of_the_wrong_direction_is_one_depth_everywhere_and_named() -> None:
    depth, points = frame_of_depth(50)
    reader = AlignedDepth(network(output_kind="inverse", output_scale="affine"), points, "auto")
    aligned = reader(depth)
    assert float(aligned.max() - aligned.min()) == pytest.approx(0, abs=1e-5)
    assert any(note.startswith("warning: at the 50 points") for note in reader.notes)


@pytest.mark.parametrize("stored", ["386 / depth", "1 / depth", "10 - depth"])
@pytest.mark.parametrize("kind", ["depth", "log", "inverse"])
@pytest.mark.parametrize("asked", ["auto", "none"])
def test_points_of_disparity_are_told_by_a_network_that_sees_depth(
    stored: str, kind: OutputKind, asked: str
) -> None:
    depth, points = frame_of_depth(200)
    output = {"depth": depth, "log": depth.log(), "inverse": 1 / depth}[kind]
    reversed_depth = {
        "386 / depth": 386 / points.depth,
        "1 / depth": 1 / points.depth,
        "10 - depth": 10 - points.depth,
    }[stored]
    scale: OutputScale = "affine" if asked == "auto" else "metric"
    of_image = network(output_kind=kind, output_scale=scale)
    for given, is_told in ((points.depth, False), (reversed_depth, True)):
        reader = AlignedDepth(of_image, replace(points, depth=given), asked)
        reader(output)
        told = [note for note in reader.notes if "--sparse-kind" in note]
        assert bool(told) == is_told
        assert all(note.startswith("warning") for note in told)


@pytest.mark.parametrize(("times", "kind"), [(2.0, "depth"), (1.6, "inverse"), (0.5, "depth")])
@pytest.mark.parametrize("which", ["a square", "anywhere", "few"])
def test_points_that_contradict_a_strong_network_together_are_told(
    times: float, kind: OutputKind, which: str
) -> None:
    depth, points = frame_of_depth(500)
    chosen = torch.zeros(len(points), dtype=torch.bool)
    inside = ((points.xy - 20).abs() < 7).all(dim=1)  # a ninth of the image
    chosen[inside] = True
    if which == "anywhere":
        chosen = chosen[torch.randperm(len(points), generator=torch.Generator().manual_seed(0))]
    elif which == "few":
        chosen &= ((points.xy - 20).abs() < 3).all(dim=1)
    output = depth if kind == "depth" else 1 / depth
    of_image = network(output_kind=kind, output_scale="affine")
    for given, is_told in (
        (points.depth, False),
        (points.depth * (1 + (times - 1) * chosen), True),
    ):
        reader = AlignedDepth(of_image, replace(points, depth=given), "auto")
        reader(output)
        told = [note for note in reader.notes if "agree with each other" in note]
        assert bool(told) == (is_told and which == "a square")


def test_the_order_of_the_points_says_nothing_where_a_network_follows_them_or_sees_little() -> None:
    depth, points = frame_of_depth(200)
    for of_points, output in (
        (network(input_kind="rgb+sparse", output_scale="affine"), 1 / depth),
        (network(output_kind="unknown"), 1 / depth),
        (network(output_scale="affine"), 1 / depth + 2 * torch.rand(depth.shape)),
    ):
        reader = AlignedDepth(of_points, points, "auto")
        reader(output)
        assert not any("--sparse-kind" in note for note in reader.notes)


@pytest.mark.parametrize(("wrong", "said"), [(0.2, False), (0.4, True)])
def test_more_than_a_quarter_of_outliers_is_a_warning(wrong: float, said: bool) -> None:
    depth, points = frame_of_depth(200)
    count = round(200 * wrong)
    factors = torch.cat([torch.tensor([0.2, 4.0]).repeat(count // 2), torch.ones(200 - count)])
    spoiled = replace(points, depth=points.depth * factors)
    reader = AlignedDepth(network(output_scale="affine"), spoiled, "auto")
    reader(2 * depth + 1)
    assert any("of 200 points are far off" in note for note in reader.notes) == said


@pytest.mark.parametrize("asked", ["auto", "disparity"])
def test_a_reading_can_be_stated_for_a_network_without_a_definition(asked: str) -> None:
    depth, points = frame_of_depth(50)
    open_kind = network(output_kind="unknown", output_scale="unknown")
    reader = AlignedDepth(open_kind, points, asked)
    assert torch.allclose(reader(3 / depth + 1), depth, rtol=1e-3)
    assert reader.alignment is not None
    assert reader.alignment.reading == "disparity"
    assert any("read as disparity" in note for note in reader.notes)


def test_one_point_shows_the_factor_of_a_relative_network() -> None:
    depth, points = frame_of_depth(1)
    reader = AlignedDepth(network(output_scale="affine"), points, "auto")
    assert torch.allclose(reader(depth / 7), depth, rtol=1e-3)


@pytest.mark.parametrize(
    ("stated", "asked", "is_said"),
    [("unknown", "auto", True), ("inverse", "auto", False), ("unknown", "disparity", False)],
)
def test_another_reading_that_explains_few_points_as_well_is_said_unless_one_is_stated(
    stated: OutputKind, asked: str, is_said: bool
) -> None:
    # The points show a small part of the range of depths.
    depth = torch.linspace(1, 8, 80)[None]
    noise = torch.randn(10, generator=torch.Generator().manual_seed(2))
    xy = torch.stack([torch.arange(14.0, 24.0), torch.zeros(10)], dim=1)
    points = SparsePoints(xy=xy, depth=depth[0, 14:24] * (0.02 * noise).exp(), size=(1, 80))
    predicting = network(output_kind=stated, output_scale="affine")
    reader = AlignedDepth(predicting, points, asked)
    output = (1 / depth)[None, None]
    reader(output)
    assert reader.alignment is not None
    fits = align_output(predicting.definition, points.sample(output), points, asked)
    assert reader.alignment.reading == fits[0].reading
    notes = [note for note in reader.notes if "explained as well" in note]
    assert bool(notes) == is_said
    assert all("10 points" in note and "--align" in note for note in notes)
