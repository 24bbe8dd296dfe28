"""Networks that stay open, and a frame as they take it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from pnpdepth_cli.frames.open_network import OpenNetwork
from pnpdepth_cli.models.network import load_network
from pnpdepth_cli.settings import ClosedSettings
from tests.core.networks import state_of
from tests.frames.scenes import SIZE, Brightness, Nearest, depth_of_scene, frame_in_memory, member


def test_the_image_encoder_runs_once_for_all_sets_of_points_and_the_network_stays() -> None:
    network = load_network("compact", None)
    runs = list[int]()
    before = state_of(network.module)
    first = next(network.module.encoder.children())
    handle = first.register_forward_hook(lambda *_: runs.append(1))
    frame = frame_in_memory(60)
    settings = ClosedSettings(iterations=1, lr="5%")
    fewer = replace(frame, points=frame.points.select(torch.arange(60) < 55))
    with OpenNetwork(network, "decoder.s8", settings, coarse=True, always_updated=True) as one:
        one.refine(frame)
        count = len(runs)
        shared = one.refine(fewer)
        plain = one.refine(fewer, updates=False)
        assert len(runs) == count > 0
        one.next_image()
        alone = one.refine(fewer)
    handle.remove()
    assert (shared.updated == alone.updated).all()
    assert (plain.updated == alone.aligned).all()
    assert before == state_of(network.module)


@pytest.mark.parametrize("of_points", [True, False])
def test_the_loss_is_that_of_finite_depth(of_points: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    frame = frame_in_memory(60)
    build = Nearest if of_points else Brightness
    sky = torch.where(torch.arange(SIZE[0])[:, None] < 30, torch.inf, 1.5 * depth_of_scene())
    monkeypatch.setattr(build, "forward", lambda *_: sky[None, None])
    rows = frame.points.xy[:, 1].numpy()
    settings = ClosedSettings(iterations=0, align="none", loss="l2")
    with member(build, settings=settings) as network:
        found = network.refine(frame)
    expected = np.square(0.5 * frame.points.depth.numpy()[rows >= 30]).mean()
    assert found.losses == (pytest.approx(expected),)
    assert found.step == 0
    assert torch.equal(found.updated, sky.where(sky.isfinite(), 0))
