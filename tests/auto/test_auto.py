"""The choice among candidates by held-out points, on a small network."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
import torch

from pnpdepth_cli.auto import auto, predictions
from pnpdepth_cli.auto.auto import MIN_POINTS, AutoRefined, refine_automatically
from pnpdepth_cli.auto.candidates import (
    Candidate,
    RefinementConfig,
    fusion,
)
from pnpdepth_cli.auto.choice import Choice, Competition, Fold
from pnpdepth_cli.auto.predictions import FramePasses, OpenNetworks, SplitCache
from pnpdepth_cli.choices import BASELINES
from pnpdepth_cli.completion.interpolation import in_hull
from pnpdepth_cli.core.refine import RefineSettings
from pnpdepth_cli.core.split import Split
from pnpdepth_cli.frames.frame import Frame
from pnpdepth_cli.frames.prepare import PreparedFrame, prepare
from pnpdepth_cli.models.network import Network, load_network
from pnpdepth_cli.pipeline.refinement import held_out
from pnpdepth_cli.points import SparsePoints
from tests.pipeline.frames import FrameOnDisk

SETTINGS = RefineSettings(iterations=3, lr="5%", update="adam")
CONFIG = RefinementConfig(layer="middle", settings=SETTINGS)
ONE = Competition(configs=(CONFIG,), propagations=("gp", "diffusion"))


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


def chosen(network: Network, inputs: Frame, competition: Competition = ONE) -> AutoRefined:
    """The frame refined with every configuration's network being this one."""
    names = dict.fromkeys(config.network for config in competition.configs)
    with OpenNetworks(dict.fromkeys(names, network)) as opened:
        return refine_automatically(opened, competition, inputs)


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
    result = chosen(network, inputs)
    errors = {str(one.candidate): one.error for one in result.choice.scored}
    assert set(BASELINES) < set(errors)
    limit = min(errors[name] for name in (*BASELINES, "network"))
    assert result.choice.error is not None
    assert result.choice.error <= limit + 1e-6
    assert result.choice.held_out == len(inputs.points)


def test_held_out_points_have_no_influence_on_the_depth_they_score(
    frame: FrameOnDisk, network: Network
) -> None:
    inputs = in_memory(frame)
    candidate = Candidate(config=CONFIG, iterations=3, propagate="gp")
    competition = replace(ONE, fixed=candidate)
    with OpenNetworks({"network": network}) as opened:
        fold = refine_automatically(opened, competition, inputs).folds[0]
        before = fold.at(candidate)
        changed = inputs.points.depth.clone()
        held = (inputs.points.xy[:, None] == fold.held_out.xy[None]).all(dim=2).any(dim=1)
        changed[held] *= 3
        other = replace(inputs, points=replace(inputs.points, depth=changed))
        again = refine_automatically(opened, competition, other).folds[0]
        assert torch.equal(again.held_out.xy, fold.held_out.xy)
        assert torch.equal(again.at(candidate), before)


@pytest.mark.parametrize(
    ("candidate", "weight", "enough", "scored"),
    [
        (Candidate(baseline="linear"), 1.0, 500, [1, 5]),
        (Candidate(baseline="linear"), 0.75, 500, [1, 5]),
        (Candidate(baseline="linear"), 0.5, 500, [1]),
        (Candidate(baseline="linear"), 1.0, 10, [1]),
        (Candidate(baseline="local"), 1.0, 500, [1]),
        (Candidate(config=CONFIG), 1.0, 500, [1]),
    ],
)
def test_interpolation_gets_most_weight_only_at_enough_held_out_points(
    frame: FrameOnDisk,
    network: Network,
    monkeypatch: pytest.MonkeyPatch,
    candidate: Candidate,
    weight: float,
    enough: int,
    scored: list[int],
) -> None:
    calls = []
    candidates, weights = (candidate, Candidate(config=CONFIG)), (weight, 1 - weight)

    def choose(folds: Sequence[Fold], competition: Competition) -> Choice:
        calls.append(len(folds))
        held_out = sum(len(fold.held_out) for fold in folds)
        return Choice(candidates=candidates, weights=weights, held_out=held_out)

    monkeypatch.setattr(auto, "choose", choose)
    monkeypatch.setattr(auto, "ENOUGH_HELD_OUT", 12)
    monkeypatch.setattr(auto, "ENOUGH_FOR_INTERPOLATION", enough)
    result = chosen(network, in_memory(frame))
    assert calls == scored
    assert len(result.folds) == scored[-1]


def test_of_many_held_out_points_a_part_is_scored_and_none_is_shown(
    frame: FrameOnDisk, network: Network, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(auto, "MOST_SCORED", 7)
    inputs = in_memory(frame)
    for fold in chosen(network, inputs).folds:
        assert len(fold.held_out) == 7
        kept = len(inputs.points) * (auto.FOLDS - 1) / auto.FOLDS
        assert len(fold.depths.points) == pytest.approx(kept, abs=3)


def test_held_out_points_without_any_inlier_weight_count_alike(
    frame: FrameOnDisk, network: Network, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(auto, "inlier_weights", lambda points, residual: torch.zeros_like(residual))
    result = chosen(network, in_memory(frame))
    assert result.choice.error is not None
    assert np.isfinite(result.choice.error)


def test_outliers_are_left_out_and_reported_and_the_error_hardly_grows(
    frame: FrameOnDisk, network: Network
) -> None:
    inputs = in_memory(frame)
    bad = torch.arange(len(inputs.points)) % 5 == 0
    depth = torch.where(bad, 2.5 * inputs.points.depth, inputs.points.depth)
    spoiled = replace(inputs, points=replace(inputs.points, depth=depth))
    clean, with_outliers = (chosen(network, one) for one in (inputs, spoiled))
    assert with_outliers.notes[0].endswith("points left out, inconsistent with the others")
    assert not any("left out" in note for note in clean.notes)
    left = {tuple(xy) for xy in with_outliers.frame.used.xy.tolist()}
    assert not left & {tuple(xy) for xy in inputs.points.xy[bad].tolist()}
    mae = [float(np.abs(one.frame.after - frame.depth).mean()) for one in (clean, with_outliers)]
    assert mae[1] < 1.15 * mae[0]


def test_outliers_that_are_left_out_stay_known_to_networks_that_weigh_their_points(
    frame: FrameOnDisk, network: Network, monkeypatch: pytest.MonkeyPatch
) -> None:
    inputs = in_memory(frame)
    bad = torch.arange(len(inputs.points)) % 5 == 0
    depth = torch.where(bad, 2.5 * inputs.points.depth, inputs.points.depth)
    spoiled = replace(inputs, points=replace(inputs.points, depth=depth))
    prepared: list[Frame] = []

    def recorded(network: Network, frame: Frame) -> PreparedFrame:
        prepared.append(frame)
        return prepare(network, frame)

    monkeypatch.setattr(predictions, "prepare", recorded)
    used = chosen(network, spoiled).frame.used
    of_all, *_, of_a_fold = prepared
    assert of_all.outliers is None
    assert of_a_fold.outliers is not None
    assert len(of_a_fold.outliers) == len(spoiled.points) - len(used) > 0


def test_what_cannot_be_fitted_to_points_equally_far_does_not_compete(
    frame: FrameOnDisk, network: Network
) -> None:
    inputs = in_memory(frame)
    flat = replace(inputs.points, depth=torch.full((len(inputs.points),), 2.0))
    result = chosen(network, inputs.with_points(flat))
    tried = {str(one.candidate) for one in result.choice.scored}
    assert "affine" not in tried
    assert {"nearest", "scale", "network"} <= tried
    assert result.choice.error is not None
    assert result.choice.error < 1e-5
    scores = held_out.baseline_scores(result, None)
    assert scores["affine"] == {"held_out_mae": None, "scores": None}


def test_one_refinement_gives_the_depth_after_every_number_of_updates(
    frame: FrameOnDisk, network: Network
) -> None:
    inputs = in_memory(frame)
    with OpenNetworks({"network": network}) as opened:
        passes = FramePasses(opened)
        twelve = replace(CONFIG, settings=replace(SETTINGS, iterations=12))
        path = passes.trajectory(twelve, inputs)
        for count in (0, 5, 10, 12):
            alone = replace(CONFIG, settings=replace(SETTINGS, iterations=count))
            end = passes.trajectory(alone, inputs)
            assert torch.equal(path.after(count), torch.from_numpy(end.frame.after))


def test_the_network_is_left_as_it_was(frame: FrameOnDisk, network: Network) -> None:
    state = {name: tensor.clone() for name, tensor in network.module.state_dict().items()}
    chosen(network, in_memory(frame))
    assert all(torch.equal(state[n], t) for n, t in network.module.state_dict().items())
    assert not any("forward" in module.__dict__ for module in network.module.modules())


@pytest.mark.parametrize("count", [1, MIN_POINTS - 1, MIN_POINTS, 7])
def test_few_points_are_enough(frame: FrameOnDisk, network: Network, count: int) -> None:
    result = chosen(network, in_memory(frame, count))
    assert (result.choice.error is None) == (count < MIN_POINTS)
    assert np.isfinite(result.frame.after).all()
    assert (result.frame.after > 0).all()


@pytest.mark.parametrize("positions", [1, 2, 3])
def test_points_at_very_few_positions_are_enough(
    frame: FrameOnDisk, network: Network, positions: int
) -> None:
    inputs = in_memory(frame, 12)
    close = inputs.points.xy[torch.arange(12) % positions] + 0.01 * torch.arange(12)[:, None]
    result = chosen(network, replace(inputs, points=replace(inputs.points, xy=close)))
    assert np.isfinite(result.frame.after).all()
    assert (result.frame.after > 0).all()


def test_after_the_deadline_only_the_default_and_what_bounds_it_are_scored(
    frame: FrameOnDisk, network: Network
) -> None:
    inputs, refined = in_memory(frame), Candidate(config=CONFIG, iterations=3)

    def scored(deadline: float | None) -> set[Candidate]:
        choice = chosen(network, inputs, replace(ONE, deadline=deadline)).choice
        return {one.candidate for one in choice.scored}

    assert refined in scored(None)
    assert refined in scored(time.monotonic() + 1e9)
    late = scored(time.monotonic() - 1)
    assert refined not in late
    assert {ONE.network, ONE.default} < late


def test_the_front_runs_once_for_all_sets_of_points(
    frame: FrameOnDisk, network: Network, monkeypatch: pytest.MonkeyPatch
) -> None:
    inputs = in_memory(frame)
    frames = [inputs, inputs.with_points(inputs.points.select(torch.arange(60) < 40))]
    fronts: list[object] = []
    front = Split.front
    monkeypatch.setattr(
        Split, "front", lambda *arguments: fronts.append(arguments) or front(*arguments)
    )
    with OpenNetworks({"network": network}) as opened:
        passes = FramePasses(opened)
        together = [passes.trajectory(CONFIG, each) for each in frames]
        assert len(fronts) == 1
        for each, one in zip(frames, together, strict=True):
            alone = FramePasses(opened).trajectory(CONFIG, each)
            assert torch.equal(one.after(3), alone.after(3))


def test_a_shortlisted_candidate_that_fails_on_a_frame_does_not_compete(
    frame: FrameOnDisk, network: Network
) -> None:
    nowhere = Candidate(config=replace(CONFIG, layer="unused"), iterations=3)
    competition = replace(ONE, shortlist=(Candidate(config=CONFIG, propagate="gp"), nowhere))
    result = chosen(network, in_memory(frame), competition)
    assert nowhere not in {one.candidate for one in result.choice.scored}
    assert result.choice.error is not None


def test_networks_compete_and_are_fused(frame: FrameOnDisk, network: Network) -> None:
    other = replace(CONFIG, network="other", settings=replace(SETTINGS, iterations=0))
    result = chosen(network, in_memory(frame), replace(ONE, configs=(CONFIG, other)))
    tried = [one.candidate for one in result.choice.scored]
    assert any(len(each.fused) == 2 for each in tried)
    assert any(each.config == other for each in tried)


def test_a_fusion_is_the_geometric_mean_of_its_members(
    frame: FrameOnDisk, network: Network
) -> None:
    inputs = in_memory(frame)
    plain, refined = Candidate(config=CONFIG), Candidate(config=CONFIG, iterations=3)
    with OpenNetworks({"network": network}) as opened:
        depths = refine_automatically(opened, replace(ONE, fixed=plain), inputs).depths
        one, other = depths.dense(plain), depths.dense(refined)
        fused = depths.dense(fusion((plain, refined), (1.0, 3.0)))
    assert torch.allclose(fused, one.pow(0.25) * other.pow(0.75))


def test_outside_the_hull_of_the_points_the_default_replaces_a_baseline(
    frame: FrameOnDisk, network: Network
) -> None:
    inputs = in_memory(frame)
    y = inputs.points.xy[:, 1]
    inputs = inputs.with_points(inputs.points.select(y > 20))
    linear = Candidate(baseline="linear", within_hull=True)
    with OpenNetworks({"network": network}) as opened:
        depths = refine_automatically(opened, replace(ONE, fixed=linear), inputs).depths
        dense = depths.dense(linear)
        inside = in_hull(inputs.points)
        assert not bool(inside[:20].any())
        plain = depths.dense(Candidate(baseline="linear"))
        assert torch.equal(dense[inside], plain[inside])
        xy = torch.tensor([[5.0, 3.0], [30.0, 30.0]])
        assert torch.allclose(depths.at(xy, linear), dense[[3, 30], [5, 30]], rtol=1e-4)
