"""One frame refined in memory: what it is an error of, and what a divergence leaves."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from pnpdepth_cli.errors import DivergedError, ModelError, NoPointsError
from pnpdepth_cli.frames.frame import Frame
from pnpdepth_cli.frames.method import refine_fixed
from pnpdepth_cli.frames.open_network import Member, OpenNetwork, prepare
from pnpdepth_cli.frames.refined import Refined
from pnpdepth_cli.models.definition import Fixed, ModelDefinition
from pnpdepth_cli.models.network import Network, load_network
from pnpdepth_cli.points import SparsePoints
from pnpdepth_cli.settings import ClosedSettings
from tests.commands.frames import frame_on_disk
from tests.core.networks import Net

SETTINGS = ClosedSettings(iterations=4, lr="5%", update="adam")


@pytest.fixture
def network(tmp_path: Path) -> Network:
    frame = frame_on_disk(tmp_path)
    return load_network(str(frame.model), frame.checkpoint)


def frame_of(seed: int, height: int = 46, width: int = 62, depth: float = 2.0) -> Frame:
    rng = np.random.default_rng(seed)
    xy = rng.integers(0, (width, height), (20, 2)).astype(np.float32)
    points = SparsePoints(
        xy=torch.from_numpy(xy),
        depth=torch.from_numpy(depth + rng.random(20, dtype=np.float32)),
        size=(height, width),
    )
    rgb = rng.random((height, width, 3), dtype=np.float32)
    return Frame(rgb=torch.from_numpy(rgb).permute(2, 0, 1).contiguous(), points=points)


def refined(
    network: Network, settings: ClosedSettings, frame: Frame, layer: str = "middle"
) -> Refined:
    with OpenNetwork(Member(network=network, layer=layer, settings=settings)) as opened:
        return refine_fixed(opened, frame)


def test_a_frame_without_a_point_in_the_networks_view_is_an_error(network: Network) -> None:
    network = replace(
        network, definition=replace(network.definition, size=Fixed(32, 32, fit="crop"))
    )
    xy = torch.tensor([[1.0, 20.0]])  # left of the square crop
    outside = SparsePoints(xy=xy, depth=torch.ones(1), size=(46, 62))
    with pytest.raises(NoPointsError):
        refined(network, SETTINGS, frame_of(1).with_points(outside))


def test_a_frame_whose_prediction_is_not_finite_is_an_error(network: Network) -> None:
    unknown = replace(frame_of(1), rgb=torch.full((3, 46, 62), float("nan")))
    with pytest.raises(ModelError):
        refined(network, SETTINGS, unknown)


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
def test_an_infinite_sky_is_unknown_and_its_points_have_no_part(
    network: Network, sky: Callable[[Tensor, Tensor], Tensor], align: str
) -> None:
    frame, settings = frame_of(1, height=48, width=64), replace(SETTINGS, align=align)
    below = frame.points.select(frame.points.xy[:, 1] >= 15)
    lost = len(frame.points) - len(below)
    right = refined(network, settings, frame.with_points(below))

    def with_sky(part: Net, rgb: Tensor) -> Tensor:
        depth = part.net(rgb)
        return sky(depth, (torch.arange(depth.shape[2]) < 15)[:, None])

    infinite = replace(network, module=Net(with_sky, net=network.module))
    result = refined(infinite, settings, frame, "net.middle")
    assert not result.after[:15].any()
    np.testing.assert_allclose(result.after[15:], right.after[15:], rtol=1e-5)
    np.testing.assert_allclose(result.losses, right.losses, rtol=1e-4)
    assert f"{lost} of {len(frame.points)} sparse points" in result.notes[0]


def test_a_divergence_comes_with_its_last_good_depth(network: Network) -> None:
    settings = replace(SETTINGS, lr=1e38, update="sgd", loss="l2")
    frame = refined(network, settings, frame_of(0), "decode")
    assert isinstance(frame.diverged, DivergedError)
    np.testing.assert_array_equal(frame.after, frame.before)


@pytest.mark.parametrize("weighs_points", [True, False])
def test_only_a_network_that_weighs_its_points_is_given_the_outliers_too(
    weighs_points: bool,
) -> None:
    xy, depth = torch.tensor([[0.0, 0.0], [3.0, 1.0], [2.0, 2.0]]), torch.tensor([1.0, 2.0, 30.0])
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
