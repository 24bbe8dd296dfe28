"""Frames refined in one pass of the network, against one at a time."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from pnpdepth_cli.core.split import Split
from pnpdepth_cli.errors import BatchError, DivergedError, ModelError, NoPointsError, PnpDepthError
from pnpdepth_cli.frames.frame import Frame, Refined
from pnpdepth_cli.frames.refine import refine_frame, refine_frames
from pnpdepth_cli.models.definition import Fixed
from pnpdepth_cli.models.network import Network, load_network
from pnpdepth_cli.points import SparsePoints
from pnpdepth_cli.settings import Settings
from tests.commands.frames import frame_on_disk

SETTINGS = Settings(iterations=4, lr="5%", update="adam")


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


def alone(network: Network, settings: Settings, one: Frame) -> Refined:
    with Split(network.module, "middle") as split:
        return refine_frame(network, split, settings, one)


def together(
    network: Network, settings: Settings, frames: list[Frame], layer: str = "middle"
) -> list[Refined | PnpDepthError]:
    with Split(network.module, layer) as split:
        return refine_frames(network, split, settings, frames)


@pytest.mark.parametrize("align", ["none", "scale", "auto"])
def test_frames_at_once_are_those_of_one_at_a_time(network: Network, align: str) -> None:
    settings = replace(SETTINGS, align=align)
    frames = [frame_of(seed, depth=seed + 1) for seed in range(3)]
    for one, frame in zip(frames, together(network, settings, frames), strict=True):
        assert isinstance(frame, Refined)
        expected = alone(network, settings, one)
        np.testing.assert_allclose(frame.before, expected.before, rtol=1e-5)
        np.testing.assert_allclose(frame.after, expected.after, rtol=1e-4)
        assert frame.notes == expected.notes
        assert (frame.alignment is None) == (expected.alignment is None)
        assert frame.used is one.points
        assert len(frame.held_out) == 0


def test_a_frame_that_fails_does_not_lose_the_others(network: Network) -> None:
    network = replace(
        network, definition=replace(network.definition, size=Fixed(32, 32, fit="crop"))
    )
    xy = torch.tensor([[1.0, 20.0]])  # left of the square crop
    outside = SparsePoints(xy=xy, depth=torch.ones(1), size=(46, 62))
    frames = [frame_of(0), frame_of(1).with_points(outside), frame_of(2)]
    first, failed, last = together(network, SETTINGS, frames)
    assert isinstance(failed, NoPointsError)
    assert isinstance(first, Refined)
    assert isinstance(last, Refined)
    np.testing.assert_allclose(last.after, alone(network, SETTINGS, frames[2]).after, rtol=1e-4)
    (nothing,) = together(network, SETTINGS, frames[1:2])
    assert isinstance(nothing, NoPointsError)
    with pytest.raises(NoPointsError):
        alone(network, SETTINGS, frames[1])


def test_a_frame_whose_prediction_is_not_finite_is_an_error_of_its_own(network: Network) -> None:
    unknown = replace(frame_of(1), rgb=torch.full((3, 46, 62), float("nan")))
    good, failed = together(network, SETTINGS, [frame_of(0), unknown])
    assert isinstance(good, Refined)
    assert isinstance(failed, ModelError)
    assert "not finite at 20 of 20 sparse points" in str(failed)


def test_a_divergence_comes_with_its_last_good_depth(network: Network) -> None:
    settings = replace(SETTINGS, lr=1e38, update="sgd", loss="l2")
    for frame in together(network, settings, [frame_of(0), frame_of(1)], "decode"):
        assert isinstance(frame, Refined)
        assert isinstance(frame.diverged, DivergedError)
        assert "after 1 update" in str(frame.diverged)
        np.testing.assert_array_equal(frame.after, frame.before)


def test_frames_of_two_sizes_are_not_refined_at_once(network: Network) -> None:
    with pytest.raises(BatchError, match="one at a time"):
        together(network, SETTINGS, [frame_of(0), frame_of(1, height=54)])
