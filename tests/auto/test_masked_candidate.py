"""Steps by hidden points, which chosen networks make after the choice."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from pnpdepth_cli.auto.auto import AutoRefined, refine_automatically
from pnpdepth_cli.auto.candidates import HIDDEN_POINT_STEPS, Candidate, RefinementConfig
from pnpdepth_cli.auto.choice import Competition
from pnpdepth_cli.auto.predictions import FramePasses, OpenNetworks
from pnpdepth_cli.core.refine import RefineSettings
from pnpdepth_cli.frames.frame import Frame
from pnpdepth_cli.frames.refine import refine_frame
from pnpdepth_cli.models.network import Network, load_network
from pnpdepth_cli.pipeline.refinement.held_out import competition_of
from pnpdepth_cli.pipeline.refinement.method import resolve_method
from pnpdepth_cli.pipeline.refinement.request import RefineRequest
from pnpdepth_cli.pipeline.refinement.resolve import resolve_settings
from tests.auto.test_auto import in_memory
from tests.core.split.test_split import same, state_of
from tests.pipeline.frames import frame_on_disk

PLAIN = RefinementConfig(layer="decoder.s8", settings=RefineSettings(iterations=0))
MASKED = replace(
    PLAIN,
    settings=RefineSettings(
        iterations=2, lr=1e-4, loss="log", update="adam", parameters="weights", target="masked"
    ),
)


def test_its_trajectory_is_the_refinement_alone_and_the_network_stays(tmp_path: Path) -> None:
    network, frame = load_network("compact", None), in_memory(frame_on_disk(tmp_path))
    before = state_of(network.module)
    with network.cut_at_points() as split:
        alone = refine_frame(network, split, MASKED.settings, frame)
    with OpenNetworks({"network": network}) as opened:
        passes = FramePasses(opened)
        passes.trajectory(PLAIN, frame)
        trajectory = passes.trajectory(MASKED, frame)
        passes.trajectory(PLAIN, frame)
    assert torch.equal(trajectory.after(0), torch.from_numpy(alone.before))
    assert torch.equal(trajectory.after(2), torch.from_numpy(alone.after))
    assert same(before, state_of(network.module))


@pytest.fixture(scope="module")
def compact() -> Network:
    return load_network("compact", None)


def refined(network: Network, frame: Frame, **changes: Any) -> AutoRefined:
    """The frame by `compact`, the choice being fixed."""
    competition = Competition(
        configs=(PLAIN,),
        propagations=(),
        fixed=Candidate(config=PLAIN),
        hidden_points={PLAIN: MASKED},
    )
    with OpenNetworks({"network": network}) as opened:
        return refine_automatically(opened, replace(competition, **changes), frame)


def test_a_chosen_network_makes_its_steps_and_the_choice_is_made_before_them(
    tmp_path: Path, compact: Network
) -> None:
    frame = in_memory(frame_on_disk(tmp_path))
    plain, moved = refined(compact, frame, hidden_points={}), refined(compact, frame)
    with compact.cut_at_points() as split:
        alone = refine_frame(compact, split, MASKED.settings, frame)
    assert np.array_equal(moved.frame.after, alone.after)
    assert not np.array_equal(moved.frame.after, plain.frame.after)
    assert moved.choice == plain.choice
    assert (plain.hidden_points, moved.hidden_points) == ({}, {"network": 2})


def test_no_step_is_made_after_the_deadline(tmp_path: Path, compact: Network) -> None:
    frame = in_memory(frame_on_disk(tmp_path))
    late = refined(compact, frame, deadline=time.monotonic() - 1)
    assert np.array_equal(late.frame.after, refined(compact, frame, hidden_points={}).frame.after)
    assert late.hidden_points == {}


def test_a_refinement_that_fails_leaves_the_networks_own_depth(
    tmp_path: Path, compact: Network
) -> None:
    frame = in_memory(frame_on_disk(tmp_path))
    wild = replace(MASKED, settings=replace(MASKED.settings, lr=1e30, iterations=5))
    result = refined(compact, frame, hidden_points={PLAIN: wild})
    assert np.array_equal(result.frame.after, refined(compact, frame, hidden_points={}).frame.after)


def test_steps_are_made_where_there_is_time_and_the_network_takes_points(tmp_path: Path) -> None:
    disk = frame_on_disk(tmp_path)
    networks = [load_network("compact", None), load_network(str(disk.model), disk.checkpoint)]
    method = resolve_method(RefineRequest())
    plans = [
        (
            each.definition.name,
            each,
            each.definition.layers[0],
            resolve_settings(each.definition, method.options),
        )
        for each in networks
    ]
    assert competition_of(method, plans, timed=False).hidden_points == {}
    for dense, steps in ((False, HIDDEN_POINT_STEPS), (True, 6)):
        (pair,) = competition_of(method, plans, timed=True, dense=dense).hidden_points.items()
        assert [config.network for config in pair] == ["compact", "compact"]
        assert pair[1].settings.masked
        assert pair[1].settings.iterations == steps
