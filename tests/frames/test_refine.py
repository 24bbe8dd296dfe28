"""One frame refined in memory: what it is an error of, and what a divergence leaves."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from pnpdepth_cli.completion.interpolation import linear
from pnpdepth_cli.errors import DivergedError, NoPointsError
from pnpdepth_cli.frames.frame import Frame, Refined
from pnpdepth_cli.frames.method import pipeline_of
from pnpdepth_cli.frames.open_network import prepare
from pnpdepth_cli.frames.refine_frame import refine_frame
from pnpdepth_cli.models.definition import Fixed, ModelDefinition
from pnpdepth_cli.models.network import load_network
from pnpdepth_cli.points import SparsePoints
from pnpdepth_cli.settings import ClosedSettings, Settings
from tests.core.networks import Net
from tests.frames.scenes import Brightness, frame_in_memory, member, opened

SETTINGS = ClosedSettings(iterations=4, lr="5%", update="adam")
PAPER = pipeline_of(Settings(method="paper"))


def refined(
    build: type[Brightness], frame: Frame, settings: ClosedSettings = SETTINGS, **definition: object
) -> Refined:
    with opened(member(build, settings=settings, always_updated=True, **definition)) as (network,):
        return refine_frame([network], frame, PAPER)


def test_a_frame_without_a_point_in_the_networks_view_is_an_error() -> None:
    frame = frame_in_memory()
    xy = torch.tensor([[1.0, 20.0]])  # left of the square crop
    outside = SparsePoints(xy=xy, depth=torch.ones(1), size=frame.size)
    with pytest.raises(NoPointsError):
        refined(Brightness, replace(frame, points=outside), size=Fixed(32, 32, fit="crop"))


@pytest.mark.parametrize(
    "sky",
    [
        lambda depth, sky: torch.where(sky, torch.inf, depth),
        lambda depth, sky: torch.where(sky, torch.nan, depth),
        lambda depth, sky: 1 / (~sky / depth),  # infinite slope, too
    ],
    ids=["inf", "nan", "division by zero"],
)
@pytest.mark.parametrize("align", ["none", "scale"])
def test_an_infinite_sky_has_no_part_in_the_updates(
    sky: Callable[[Tensor, Tensor], Tensor], align: str
) -> None:
    class Sky(Brightness):
        def forward(self, rgb: Tensor) -> Tensor:
            return sky(super().forward(rgb), (torch.arange(rgb.shape[2]) < 15)[:, None])

    frame = frame_in_memory()
    settings = replace(SETTINGS, align=align)
    below = frame.points.select(frame.points.xy[:, 1] >= 15)
    lost = len(frame.points) - len(below)
    right = refined(Brightness, replace(frame, points=below), settings)
    result = refined(Sky, frame, settings)
    assert not result.depth[:15].any()
    np.testing.assert_allclose(result.depth[15:], right.depth[15:], rtol=1e-5)
    np.testing.assert_allclose(result.losses, right.losses, rtol=1e-4)
    assert f"{lost} of {len(frame.points)} sparse points" in result.notes[0]


def test_a_divergence_comes_with_its_last_good_depth() -> None:
    settings = replace(SETTINGS, lr=1e38, update="sgd", loss="l2")
    result = refined(Brightness, frame_in_memory(), settings)
    assert isinstance(result.diverged, DivergedError)
    np.testing.assert_array_equal(result.depth, result.before)


def test_a_validated_frame_is_refined_again_without_its_validation_points() -> None:
    frame = frame_in_memory(60)
    validated = pipeline_of(Settings(method="paper", propagate="local"), validated=True)
    with opened(member(Brightness, settings=SETTINGS, always_updated=True)) as networks:
        checked = refine_frame(networks, frame, validated).validation
        assert (len(checked.points), len(checked.kept)) == (12, 48)
        others = replace(frame, points=checked.kept)
        again = refine_frame(networks, others, replace(validated, validates=False))
        assert refine_frame(networks, frame_in_memory(4), validated).validation is None
    assert again.validation is None
    for stage, depth in (("before", again.before), ("after", again.depth)):
        expected = checked.points.sample(torch.from_numpy(depth))
        assert torch.allclose(checked.predicted[stage], expected, rtol=1e-5)
    expected = linear(checked.kept, checked.points.xy)
    assert torch.equal(checked.predicted["linear"], expected)


@pytest.mark.parametrize("weighs_points", [True, False])
def test_only_a_network_that_weighs_points_is_given_the_outliers_too(weighs_points: bool) -> None:
    xy = torch.tensor([[0.0, 0.0], [3.0, 1.0], [2.0, 2.0]])
    depth = torch.tensor([1.0, 2.0, 30.0])
    points = SparsePoints(xy=xy, depth=depth, size=(4, 4))
    frame = Frame(rgb=None, points=points).without(torch.tensor([False, False, True]))
    assert frame.points.depth.tolist() == [1.0, 2.0]
    definition = ModelDefinition(
        name="same",
        build=lambda: Net(lambda net, sparse: sparse),
        size=Fixed(2, 2),
        input_kind="sparse",
        weighs_points=weighs_points,
    )
    prepared = prepare(load_network(definition, None), frame)
    (sparse,) = prepared.arguments
    assert sparse[0, 0].tolist() == [[1.0, 2.0], [0.0, 30.0 if weighs_points else 0.0]]
    assert prepared.points.depth.tolist() == [1.0, 2.0]
