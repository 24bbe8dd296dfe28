"""Points hidden from a network's input, as a candidate of the choice by held-out points."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import torch

from pnpdepth_cli.auto.auto import refine_automatically
from pnpdepth_cli.auto.candidates import Candidate, RefinementConfig
from pnpdepth_cli.auto.choice import Competition
from pnpdepth_cli.auto.predictions import FramePasses, OpenNetworks
from pnpdepth_cli.core.refine import RefineSettings
from pnpdepth_cli.frames.refine import refine_frame
from pnpdepth_cli.models.definition import ModelDefinition
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
        passes = FramePasses(opened, frame)
        passes.trajectory(PLAIN, frame.points)
        trajectory = passes.trajectory(MASKED, frame.points)
        passes.trajectory(PLAIN, frame.points)
    assert torch.equal(trajectory.after(0), torch.from_numpy(alone.before))
    assert torch.equal(trajectory.after(2), torch.from_numpy(alone.after))
    assert same(before, state_of(network.module))


def test_it_competes_while_there_is_time(tmp_path: Path) -> None:
    frame = in_memory(frame_on_disk(tmp_path))
    competition = Competition(configs=(PLAIN,), more_configs=(MASKED,), propagations=("gp",))
    late = replace(competition, deadline=0.0)
    early = replace(competition, deadline=1e9)
    with OpenNetworks({"network": load_network("compact", None)}) as opened:
        tried = [
            {str(each.candidate) for each in refine_automatically(opened, one, frame).choice.scored}
            for one in (late, early)
        ]
    name = str(Candidate(config=MASKED, iterations=2))
    assert name == "2 updates of weights (network, hidden points, adam, step 0.0001)"
    assert name not in tried[0]
    assert name in tried[1]


def test_it_is_tried_first_and_only_where_the_network_takes_points(tmp_path: Path) -> None:
    disk = frame_on_disk(tmp_path)
    networks = [load_network("compact", None), load_network(str(disk.model), disk.checkpoint)]
    first = [_more_configs(network)[0].settings.masked for network in networks]
    assert first == [True, False]


def _more_configs(network: Network) -> tuple[RefinementConfig, ...]:
    definition: ModelDefinition = network.definition
    method = resolve_method(RefineRequest())
    settings = resolve_settings(definition, method.options)
    plan = ("network", network, definition.layers[0], settings)
    return competition_of(method, [plan], timed=True).more_configs
