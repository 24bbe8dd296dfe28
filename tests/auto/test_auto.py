"""The choice among candidates by held-out points, on a small network."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from pnpdepth_cli.auto import auto
from pnpdepth_cli.auto.auto import MIN_POINTS, refine_automatically
from pnpdepth_cli.auto.candidates import (
    Candidate,
    RefinementConfig,
    SplitCache,
    default_configs,
    trajectories,
)
from pnpdepth_cli.choices import BASELINES
from pnpdepth_cli.core.refine import RefineSettings
from pnpdepth_cli.core.split import Split
from pnpdepth_cli.frames.frame import Frame
from pnpdepth_cli.models.network import Network, load_network
from pnpdepth_cli.pipeline.refinement import held_out
from pnpdepth_cli.points import SparsePoints
from tests.pipeline.frames import FrameOnDisk, frame_on_disk

SETTINGS = RefineSettings(iterations=3, lr="5%", update="adam")
CONFIG = RefinementConfig(layer="middle", settings=SETTINGS)


@pytest.fixture
def frame(tmp_path: Path) -> FrameOnDisk:
    return frame_on_disk(tmp_path)


@pytest.fixture
def network(frame: FrameOnDisk) -> Network:
    return load_network(str(frame.model), frame.checkpoint)


def in_memory(frame: FrameOnDisk, count: int = 60) -> Frame:
    rng = np.random.default_rng(1)
    rows, columns = (rng.integers(0, n, count) for n in frame.depth.shape)
    points = SparsePoints(
        xy=torch.from_numpy(np.stack([columns, rows], 1).astype(np.float32)),
        depth=torch.from_numpy(frame.depth[rows, columns]),
        size=(frame.depth.shape[0], frame.depth.shape[1]),
    )
    rgb = rng.random((*frame.depth.shape, 3), dtype=np.float32)
    return Frame(rgb=torch.from_numpy(rgb).permute(2, 0, 1).contiguous(), points=points)


def refined(network: Network, *given: Any, **options: Any) -> dict[RefinementConfig, list[Any]]:
    """The trajectories of a network that is cut for them alone."""
    with SplitCache(network) as cache:
        return trajectories(cache, *given, **options)


def test_a_held_cut_is_one_as_long_as_the_layer_stays_the_same(network: Network) -> None:
    with SplitCache(network) as cache:
        first = cache.at("middle")
        assert cache.at("middle") is first
        other = cache.at("encode")
        assert other is not first
        assert other.layer == "encode"
    assert not any("forward" in module.__dict__ for module in network.module.modules())


def test_what_is_chosen_is_no_worse_at_held_out_points_than_network_and_baselines(
    frame: FrameOnDisk, network: Network
) -> None:
    inputs = in_memory(frame)
    configs = default_configs(network.definition, "middle", SETTINGS)
    found = refine_automatically(network, configs, inputs)
    errors = {str(one.candidate): one.error for one in found.choice.scored}
    assert set(BASELINES) < set(errors)
    assert "network" in errors
    assert found.choice.error is not None
    assert found.choice.error <= min(errors.values()) + 1e-6
    assert found.choice.held_out == len(inputs.points)


def test_held_out_points_do_not_tell_the_depth_that_they_score(
    frame: FrameOnDisk, network: Network
) -> None:
    inputs = in_memory(frame)
    found = refine_automatically(network, [CONFIG], inputs)
    fold, way = found.folds[0], Candidate(config=CONFIG, iterations=3, propagate="gp")
    before = fold.at(way)
    wrong = inputs.points.depth.clone()
    held = (inputs.points.xy[:, None] == fold.held_out.xy[None]).all(dim=2).any(dim=1)
    wrong[held] *= 3
    other = replace(inputs, points=replace(inputs.points, depth=wrong))
    again = refine_automatically(network, [CONFIG], other)
    assert torch.equal(again.folds[0].held_out.xy, fold.held_out.xy)
    assert torch.equal(again.folds[0].at(way), before)


def test_held_out_points_without_any_inlier_weight_count_alike(
    frame: FrameOnDisk, network: Network, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(auto, "inlier_weights", lambda points, residual: torch.zeros_like(residual))
    inputs = in_memory(frame)
    found = refine_automatically(network, [CONFIG], inputs)
    assert found.choice.error is not None
    assert found.choice.error <= min(one.error for one in found.choice.scored) + 1e-6


def test_wrong_points_are_left_out_and_said_and_the_depth_is_hardly_worse(
    frame: FrameOnDisk, network: Network
) -> None:
    inputs = in_memory(frame)
    bad = torch.arange(len(inputs.points)) % 5 == 0
    depth = torch.where(bad, 2.5 * inputs.points.depth, inputs.points.depth)
    spoiled = replace(inputs, points=replace(inputs.points, depth=depth))
    clean, found = (refine_automatically(network, [CONFIG], one) for one in (inputs, spoiled))
    assert found.notes[0].endswith("points left out; all around tells them otherwise")
    assert not any("left out" in note for note in clean.notes)
    left = {tuple(xy) for xy in found.frame.used.xy.tolist()}
    assert not left & {tuple(xy) for xy in inputs.points.xy[bad].tolist()}
    mae = [float(np.abs(one.frame.after - frame.depth).mean()) for one in (clean, found)]
    assert mae[1] < 1.15 * mae[0]


def test_what_cannot_be_fitted_to_points_equally_far_does_not_compete(
    frame: FrameOnDisk, network: Network
) -> None:
    inputs = in_memory(frame)
    flat = replace(inputs.points, depth=torch.full((len(inputs.points),), 2.0))
    found = refine_automatically(network, [CONFIG], inputs.with_points(flat))
    tried = {str(one.candidate) for one in found.choice.scored}
    assert "affine" not in tried
    assert {"nearest", "scale", "network"} <= tried
    assert found.choice.error is not None
    assert found.choice.error < 1e-5
    scores = held_out.baseline_scores(found, None)
    assert scores["affine"] == {"held_out_mae": None, "scores": None}


def test_one_refinement_gives_the_depth_after_every_number_of_updates(
    frame: FrameOnDisk, network: Network
) -> None:
    inputs = in_memory(frame)
    (path,) = refined(network, [CONFIG], inputs, [inputs.points])[CONFIG]
    for count in (0, 1, 2, 3):
        alone = RefinementConfig(layer="middle", settings=replace(SETTINGS, iterations=count))
        (end,) = refined(network, [alone], inputs, [inputs.points])[alone]
        assert torch.equal(path.after(count), torch.from_numpy(end.frame.after))  # type: ignore[union-attr]


def test_the_network_is_left_as_it_was(frame: FrameOnDisk, network: Network) -> None:
    inputs = in_memory(frame)
    state = {name: tensor.clone() for name, tensor in network.module.state_dict().items()}
    refine_automatically(network, [CONFIG], inputs)
    assert all(torch.equal(state[n], t) for n, t in network.module.state_dict().items())
    assert not any("forward" in module.__dict__ for module in network.module.modules())


@pytest.mark.parametrize("count", [1, MIN_POINTS - 1, MIN_POINTS, 7])
def test_few_points_are_enough(frame: FrameOnDisk, network: Network, count: int) -> None:
    inputs = in_memory(frame, count)
    found = refine_automatically(network, [CONFIG], inputs)
    assert (found.choice.error is None) == (count < MIN_POINTS)
    assert np.isfinite(found.frame.after).all()
    assert (found.frame.after > 0).all()


@pytest.mark.parametrize("places", [1, 2, 3])
def test_points_at_very_few_places_are_enough(
    frame: FrameOnDisk, network: Network, places: int
) -> None:
    inputs = in_memory(frame, 12)
    close = inputs.points.xy[torch.arange(12) % places] + 0.01 * torch.arange(12)[:, None]
    inputs = replace(inputs, points=replace(inputs.points, xy=close))
    found = refine_automatically(network, [CONFIG], inputs)
    assert np.isfinite(found.frame.after).all()
    assert (found.frame.after > 0).all()


def test_trials_that_cost_more_are_made_only_with_a_time_budget(
    frame: FrameOnDisk, network: Network, monkeypatch: pytest.MonkeyPatch
) -> None:
    inputs = in_memory(frame)
    configs = default_configs(network.definition, "middle", SETTINGS)
    layers = {config.layer for config in configs}
    assert layers == {"encode", "middle"}

    def tried(budget_s: float | None) -> set[RefinementConfig]:
        found = refine_automatically(network, configs, inputs, budget_s=budget_s)
        return {
            one.candidate.config for one in found.choice.scored if one.candidate.config is not None
        }

    assert {config.layer for config in tried(None)} == {"middle"}
    assert tried(1e9) >= {t for t in configs if t.settings.align == "none"}
    monkeypatch.setattr(auto.time, "monotonic", iter(range(0, 10**9, 10)).__next__)
    assert len({(one.layer, one.settings.update) for one in tried(5.0)}) == 1


def test_trials_of_one_layer_share_what_lies_in_front_of_it(
    frame: FrameOnDisk, network: Network, monkeypatch: pytest.MonkeyPatch
) -> None:
    inputs = in_memory(frame)
    other = replace(CONFIG, settings=replace(SETTINGS, update="sign"))
    sets = [inputs.points, inputs.points.select(torch.arange(60) < 40)]
    fronts: list[object] = []
    front = Split.front
    monkeypatch.setattr(Split, "front", lambda *given: fronts.append(given) or front(*given))
    both = refined(network, [CONFIG, other], inputs, sets)
    assert len(fronts) == (1 if network.definition.input_kind == "rgb" else 2)
    for config in (CONFIG, other):
        alone = refined(network, [config], inputs, sets)[config]
        for one, same in zip(both[config], alone, strict=True):
            assert torch.equal(one.after(3), same.after(3))  # type: ignore[union-attr]


def test_a_redundant_configuration_is_not_refined(frame: FrameOnDisk, network: Network) -> None:
    inputs = in_memory(frame)
    other = replace(CONFIG, settings=replace(SETTINGS, update="sign"))
    made = refined(
        network, [CONFIG, other], inputs, [inputs.points], is_redundant=lambda config, _: True
    )
    assert list(made) == [CONFIG]


def test_a_shortlisted_candidate_that_this_frame_has_not_does_not_compete(
    frame: FrameOnDisk, network: Network
) -> None:
    inputs = in_memory(frame)
    elsewhere = replace(CONFIG, settings=replace(SETTINGS, align="auto"))
    found = refine_automatically(
        network,
        [CONFIG],
        inputs,
        shortlist=[Candidate(config=elsewhere, iterations=3), Candidate(config=CONFIG)],
    )
    assert elsewhere not in {one.candidate.config for one in found.choice.scored}
    assert found.choice.error is not None
