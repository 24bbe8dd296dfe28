"""--auto, --baselines, --uncertainty and --propagate, on a small network."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from pnpdepth_cli.completion.baselines import BASELINES
from pnpdepth_cli.core.refine import RefineSettings
from pnpdepth_cli.core.split import Split
from pnpdepth_cli.errors import ModelError, UsageError
from pnpdepth_cli.io.depth import read_depth
from pnpdepth_cli.models.definition import InputKind
from pnpdepth_cli.models.network import Network, load_network
from pnpdepth_cli.pipeline.refinement import auto, held_out
from pnpdepth_cli.pipeline.refinement.auto import (
    FEWEST,
    Choice,
    Scored,
    refine_automatically,
    usual_trials,
)
from pnpdepth_cli.pipeline.refinement.inputs import Inputs
from pnpdepth_cli.pipeline.refinement.request import RefineRequest
from pnpdepth_cli.pipeline.refinement.ways import HeldCut, Trial, Way, trajectories
from pnpdepth_cli.points import SparsePoints
from tests.pipeline.batches import NAMES, Heard, batch, pairs_on_disk, results, times
from tests.pipeline.frames import FrameOnDisk, frame_on_disk, run

SETTINGS = RefineSettings(iterations=3, lr="5%", update="adam")
TRIAL = Trial(layer="middle", settings=SETTINGS)


@pytest.fixture
def frame(tmp_path: Path) -> FrameOnDisk:
    return frame_on_disk(tmp_path)


@pytest.fixture
def network(frame: FrameOnDisk) -> Network:
    return load_network(str(frame.model), frame.checkpoint)


def inputs_of(frame: FrameOnDisk, count: int = 60) -> Inputs:
    rng = np.random.default_rng(1)
    rows, columns = (rng.integers(0, n, count) for n in frame.depth.shape)
    points = SparsePoints(
        xy=torch.from_numpy(np.stack([columns, rows], 1).astype(np.float32)),
        depth=torch.from_numpy(frame.depth[rows, columns]),
        size=(frame.depth.shape[0], frame.depth.shape[1]),
    )
    rgb = rng.random((*frame.depth.shape, 3), dtype=np.float32)
    return Inputs(rgb=rgb, points=points, gt=None, sparse_scale=None, record={}, notes=())


def refined(network: Network, *given: Any, **options: Any) -> dict[Trial, list[Any]]:
    """The trajectories of a network that is cut for them alone."""
    with HeldCut(network) as cut:
        return trajectories(cut, *given, **options)


def test_a_held_cut_is_one_as_long_as_the_layer_stays_the_same(network: Network) -> None:
    with HeldCut(network) as cut:
        first = cut.at("middle")
        assert cut.at("middle") is first
        other = cut.at("encode")
        assert other is not first
        assert other.layer == "encode"
    assert not any("forward" in module.__dict__ for module in network.module.modules())


def test_what_is_chosen_is_no_worse_at_held_out_points_than_network_and_baselines(
    frame: FrameOnDisk, network: Network
) -> None:
    inputs = inputs_of(frame)
    trials = usual_trials(network.definition, "middle", SETTINGS)
    found = refine_automatically(network, trials, inputs, inputs.points)
    errors = {str(one.way): one.error for one in found.choice.scored}
    assert set(BASELINES) < set(errors)
    assert "network" in errors
    assert found.choice.error is not None
    assert found.choice.error <= min(errors.values()) + 1e-6
    assert found.choice.held_out == len(inputs.points)


def test_held_out_points_do_not_tell_the_depth_that_they_score(
    frame: FrameOnDisk, network: Network
) -> None:
    inputs = inputs_of(frame)
    found = refine_automatically(network, [TRIAL], inputs, inputs.points)
    fold, way = found.folds[0], Way(trial=TRIAL, iterations=3, propagate="gp")
    before = fold.at(way)
    wrong = inputs.points.depth.clone()
    held = (inputs.points.xy[:, None] == fold.held_out.xy[None]).all(dim=2).any(dim=1)
    wrong[held] *= 3
    other = replace(inputs, points=replace(inputs.points, depth=wrong))
    again = refine_automatically(network, [TRIAL], other, other.points)
    assert torch.equal(again.folds[0].held_out.xy, fold.held_out.xy)
    assert torch.equal(again.folds[0].at(way), before)


def test_held_out_points_of_which_none_is_believed_count_alike(
    frame: FrameOnDisk, network: Network, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(auto, "trust", lambda points, missing: torch.zeros_like(missing))
    inputs = inputs_of(frame)
    found = refine_automatically(network, [TRIAL], inputs, inputs.points)
    assert found.choice.error is not None
    assert found.choice.error <= min(one.error for one in found.choice.scored) + 1e-6


def test_wrong_points_are_left_out_and_said_and_the_depth_is_hardly_worse(
    frame: FrameOnDisk, network: Network
) -> None:
    inputs = inputs_of(frame)
    bad = torch.arange(len(inputs.points)) % 5 == 0
    depth = torch.where(bad, 2.5 * inputs.points.depth, inputs.points.depth)
    spoiled = replace(inputs, points=replace(inputs.points, depth=depth))
    clean, found = (
        refine_automatically(network, [TRIAL], one, one.points) for one in (inputs, spoiled)
    )
    assert found.notes[0].endswith("points left out; all around tells them otherwise")
    assert not any("left out" in note for note in clean.notes)
    left = {tuple(xy) for xy in found.frame.used.xy.tolist()}
    assert not left & {tuple(xy) for xy in inputs.points.xy[bad].tolist()}
    mae = [float(np.abs(one.frame.after - frame.depth).mean()) for one in (clean, found)]
    assert mae[1] < 1.15 * mae[0]


@pytest.mark.parametrize(
    ("kind", "network_m", "warned"),
    [
        ("rgb+sparse", 0.3, True),
        ("rgb+sparse", 0.1, False),
        ("sparse", 0.3, True),
        ("rgb", 0.3, False),
    ],
)
def test_of_a_network_that_takes_the_points_it_is_said_what_holding_some_out_does_to_it(
    frame: FrameOnDisk, network: Network, kind: InputKind, network_m: float, warned: bool
) -> None:
    scored = [Scored(way=Way(baseline=name), error=0.2) for name in BASELINES]
    scored.append(Scored(way=Way(trial=TRIAL), error=network_m))
    best = min(scored, key=lambda one: one.error)
    choice = Choice(
        ways=(best.way,), weights=(1.0,), error=best.error, network=network_m, scored=tuple(scored)
    )
    request = RefineRequest.from_fields(image=frame.image, sparse=frame.sparse, auto=True)
    notes = held_out.auto_notes(choice, request, replace(network.definition, input_kind=kind))
    assert notes[0].startswith("auto: ")
    assert any("takes the points itself" in note for note in notes[1:]) == warned


def test_the_networks_error_is_that_of_the_network_alone(
    frame: FrameOnDisk, network: Network
) -> None:
    inputs = inputs_of(frame)
    found = refine_automatically(
        network, usual_trials(network.definition, "middle", SETTINGS), inputs, inputs.points
    )
    errors = {str(one.way): one.error for one in found.choice.scored}
    assert found.choice.network == errors["network"]
    assert any("network" in name and name != "network" for name in errors)  # none of it alone
    request = RefineRequest.from_fields(image=frame.image, sparse=frame.sparse, auto=True)
    note = held_out.auto_notes(found.choice, request, network.definition)[0]
    assert f"network {errors['network']:.4f} m" in note


def test_what_cannot_be_fitted_to_points_equally_far_does_not_compete(
    frame: FrameOnDisk, network: Network
) -> None:
    inputs = inputs_of(frame)
    flat = replace(inputs.points, depth=torch.full((len(inputs.points),), 2.0))
    found = refine_automatically(network, [TRIAL], replace(inputs, points=flat), flat)
    tried = {str(one.way) for one in found.choice.scored}
    assert "affine" not in tried
    assert {"nearest", "scale", "network"} <= tried
    assert found.choice.error is not None
    assert found.choice.error < 1e-5
    scores = held_out.baseline_scores(found, inputs)
    assert scores["affine"] == {"held_out_mae": None, "scores": None}


@pytest.mark.parametrize(
    ("asked", "tried"), [(None, {"none", "gp", "diffusion"}), ("gp", {"none", "gp"}),
                         ("none", {"none"})],
)  # fmt: skip
def test_with_auto_only_the_propagation_that_is_asked_for_competes(
    frame: FrameOnDisk, asked: str | None, tried: set[str]
) -> None:
    record = run(frame, auto=True, propagate=asked).record
    assert {each.get("propagate", "none") for each in record["auto"]["tried"]} == tried
    assert record["settings"]["propagate"] == asked


def test_one_refinement_gives_the_depth_after_every_number_of_updates(
    frame: FrameOnDisk, network: Network
) -> None:
    inputs = inputs_of(frame)
    (path,) = refined(network, [TRIAL], inputs, [inputs.points])[TRIAL]
    for count in (0, 1, 2, 3):
        alone = Trial(layer="middle", settings=replace(SETTINGS, iterations=count))
        (end,) = refined(network, [alone], inputs, [inputs.points])[alone]
        assert torch.equal(path.after(count), torch.from_numpy(end.frame.after))  # type: ignore[union-attr]


def test_the_network_is_left_as_it_was(frame: FrameOnDisk, network: Network) -> None:
    inputs = inputs_of(frame)
    state = {name: tensor.clone() for name, tensor in network.module.state_dict().items()}
    refine_automatically(network, [TRIAL], inputs, inputs.points)
    assert all(torch.equal(state[n], t) for n, t in network.module.state_dict().items())
    assert not any("forward" in module.__dict__ for module in network.module.modules())


@pytest.mark.parametrize("count", [1, FEWEST - 1, FEWEST, 7])
def test_few_points_are_enough(frame: FrameOnDisk, network: Network, count: int) -> None:
    inputs = inputs_of(frame, count)
    found = refine_automatically(network, [TRIAL], inputs, inputs.points)
    assert (found.choice.error is None) == (count < FEWEST)
    assert np.isfinite(found.frame.after).all()
    assert (found.frame.after > 0).all()


@pytest.mark.parametrize("places", [1, 2, 3])
def test_points_at_very_few_places_are_enough(
    frame: FrameOnDisk, network: Network, places: int
) -> None:
    inputs = inputs_of(frame, 12)
    close = inputs.points.xy[torch.arange(12) % places] + 0.01 * torch.arange(12)[:, None]
    inputs = replace(inputs, points=replace(inputs.points, xy=close))
    found = refine_automatically(network, [TRIAL], inputs, inputs.points)
    assert np.isfinite(found.frame.after).all()
    assert (found.frame.after > 0).all()


def test_trials_that_cost_more_are_made_only_with_a_time_budget(
    frame: FrameOnDisk, network: Network, monkeypatch: pytest.MonkeyPatch
) -> None:
    inputs = inputs_of(frame)
    trials = usual_trials(network.definition, "middle", SETTINGS)
    layers = {trial.layer for trial in trials}
    assert layers == {"encode", "middle"}

    def tried(budget_s: float | None) -> set[Trial]:
        found = refine_automatically(network, trials, inputs, inputs.points, budget_s=budget_s)
        return {one.way.trial for one in found.choice.scored if one.way.trial is not None}

    assert {trial.layer for trial in tried(None)} == {"middle"}
    assert tried(1e9) >= {t for t in trials if t.settings.align == "none"}
    monkeypatch.setattr(auto.time, "monotonic", iter(range(0, 10**9, 10)).__next__)
    assert len({(one.layer, one.settings.update) for one in tried(5.0)}) == 1


def test_trials_of_one_layer_share_what_lies_in_front_of_it(
    frame: FrameOnDisk, network: Network, monkeypatch: pytest.MonkeyPatch
) -> None:
    inputs = inputs_of(frame)
    other = replace(TRIAL, settings=replace(SETTINGS, update="sign"))
    sets = [inputs.points, inputs.points.select(torch.arange(60) < 40)]
    fronts: list[object] = []
    front = Split.front
    monkeypatch.setattr(Split, "front", lambda *given: fronts.append(given) or front(*given))
    both = refined(network, [TRIAL, other], inputs, sets)
    assert len(fronts) == (1 if network.definition.input_kind == "rgb" else 2)
    for trial in (TRIAL, other):
        alone = refined(network, [trial], inputs, sets)[trial]
        for one, same in zip(both[trial], alone, strict=True):
            assert torch.equal(one.after(3), same.after(3))  # type: ignore[union-attr]


def test_what_is_needless_after_the_first_is_not_made(frame: FrameOnDisk, network: Network) -> None:
    inputs = inputs_of(frame)
    other = replace(TRIAL, settings=replace(SETTINGS, update="sign"))
    made = refined(network, [TRIAL, other], inputs, [inputs.points], needless=lambda trial, _: True)
    assert list(made) == [TRIAL]


def test_the_record_says_what_was_chosen_and_everything_that_was_tried(frame: FrameOnDisk) -> None:
    record = run(frame, auto=True, gt=frame.gt).record
    made = record["auto"]
    assert abs(sum(each["weight"] for each in made["chosen"]) - 1) < 1e-9
    errors = [each["held_out_mae"] for each in made["tried"]]
    assert errors == sorted(errors)
    assert made["held_out_mae"] <= errors[0] + 1e-6
    assert made["held_out_points"] == 60
    assert any(note.startswith("auto: ") for note in record["notes"])
    saved = json.loads((frame.folder / "out" / "img.json").read_text())
    assert saved["auto"] == json.loads(json.dumps(made))


def test_the_same_request_gives_the_same_bytes(frame: FrameOnDisk) -> None:
    run(frame, auto=True, uncertainty=True, output=frame.folder / "a")
    run(frame, auto=True, uncertainty=True, output=frame.folder / "b")
    for name in ("img_depth.png", "img_sigma.exr"):
        assert (frame.folder / "a" / name).read_bytes() == (frame.folder / "b" / name).read_bytes()


def test_baselines_are_scored_at_held_out_points_and_against_the_truth(frame: FrameOnDisk) -> None:
    found = run(frame, baselines=True, gt=frame.gt).record["baselines"]
    assert set(found) == {*BASELINES, "network", "result"}
    for row in found.values():
        assert row["held_out_mae"] > 0
        assert row["scores"]["mae"] > 0
    plain = run(frame, gt=frame.gt, output=frame.folder / "plain").record["scores"]
    assert found["result"]["scores"]["mae"] == plain["after"]["mae"]  # nothing else has changed
    assert found["network"]["scores"]["mae"] == plain["before"]["mae"]


def test_the_standard_deviation_is_positive_and_in_a_file_of_its_own(frame: FrameOnDisk) -> None:
    record = run(frame, uncertainty=True).record
    sigma = read_depth(Path(record["outputs"]["sigma"])).values
    assert sigma.shape == frame.depth.shape
    assert (sigma > 0).all()
    with pytest.raises(UsageError, match="--uncertainty writes a second file"):
        run(frame, uncertainty=True, output=frame.folder / "depth.exr")


def test_propagation_follows_refinement(frame: FrameOnDisk) -> None:
    plain = run(frame, format="npy", output=frame.folder / "plain")
    spread = run(frame, format="npy", output=frame.folder / "gp", propagate="gp")
    errors = [each.record["sparse_error"]["after"]["mae"] for each in (plain, spread)]
    assert errors[1] < errors[0]


def test_a_batch_finds_its_ways_on_a_few_frames_and_checks_them_on_each(tmp_path: Path) -> None:
    root = pairs_on_disk(tmp_path / "drive")
    heard = Heard()
    batch(root, heard, refine={"auto": True})
    (said,) = [text for text in heard.said if text.startswith("auto: ")]
    found = said.partition(": best on ")[2].partition(": ")[2].split("; ")
    for name in NAMES:
        made = json.loads((root / "out" / f"{name}.json").read_text())["auto"]
        tried = {each["way"] for each in made["tried"]}
        assert set(found) <= tried
        assert {*BASELINES, "network"} <= tried
        assert made["held_out_mae"] <= made["tried"][0]["held_out_mae"] + 1e-6
    before = times(root / "out")
    batch(root, refine={"auto": True})
    assert times(root / "out") == before


def test_a_frame_that_no_way_can_be_found_on_does_not_stop_a_batch(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root = pairs_on_disk(tmp_path / "drive")
    whole, calls = held_out.refine_automatically, []

    def failing_first(*given: Any, **options: Any) -> Any:
        calls.append(None)
        if len(calls) == 1:
            raise ModelError("no way")
        return whole(*given, **options)

    monkeypatch.setattr(held_out, "refine_automatically", failing_first)
    batch(root, refine={"auto": True})
    assert all((root / "out" / f"{name}.json").exists() for name in NAMES)


def test_shards_find_the_same_ways(tmp_path: Path) -> None:
    root = pairs_on_disk(tmp_path / "drive")
    batch(root, refine={"auto": True})
    whole = results(root / "out")
    for number in (1, 2):
        batch(root, refine={"auto": True}, output=tmp_path / "parts", shard=(number, 2))
    parts = results(tmp_path / "parts")
    assert {n: b for n, b in parts.items() if isinstance(b, bytes)} == {
        n: b for n, b in whole.items() if isinstance(b, bytes)
    }
