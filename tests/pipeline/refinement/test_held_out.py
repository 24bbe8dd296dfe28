"""--auto, --baselines, --uncertainty and --propagate of `pnpdepth refine` and `batch`."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from pnpdepth_cli.auto.candidates import Candidate, RefinementConfig
from pnpdepth_cli.auto.choice import Choice, ScoredCandidate
from pnpdepth_cli.choices import BASELINES
from pnpdepth_cli.core.refine import RefineSettings
from pnpdepth_cli.errors import UsageError
from pnpdepth_cli.io.depth import read_depth
from pnpdepth_cli.models.definition import InputKind
from pnpdepth_cli.models.network import Network, load_network
from pnpdepth_cli.pipeline.refinement import held_out
from tests.pipeline.batches import batch, pairs_on_disk, results
from tests.pipeline.frames import FrameOnDisk, run

CONFIG = RefinementConfig(layer="middle", settings=RefineSettings(iterations=3))


@pytest.fixture
def network(frame: FrameOnDisk) -> Network:
    return load_network(str(frame.model), frame.checkpoint)


@pytest.mark.parametrize(
    ("kind", "network_m", "warned"),
    [
        ("rgb+sparse", 0.3, True),
        ("rgb+sparse", 0.1, False),
        ("sparse", 0.3, True),
        ("rgb", 0.3, False),
    ],
)
def test_a_network_that_takes_the_points_gets_a_note_on_held_out_points(
    frame: FrameOnDisk, network: Network, kind: InputKind, network_m: float, warned: bool
) -> None:
    scored = [ScoredCandidate(candidate=Candidate(baseline=name), error=0.2) for name in BASELINES]
    scored.append(ScoredCandidate(candidate=Candidate(config=CONFIG), error=network_m))
    best = min(scored, key=lambda one: one.error)
    choice = Choice(
        candidates=(best.candidate,),
        weights=(1.0,),
        error=best.error,
        network_error=network_m,
        scored=tuple(scored),
    )
    notes = held_out.choice_notes(choice, replace(network.definition, input_kind=kind))
    assert notes[0].startswith("choice: ")
    assert any("takes the points itself" in note for note in notes[1:]) == warned


def test_the_networks_error_is_that_of_the_network_alone(frame: FrameOnDisk) -> None:
    record = run(frame, auto=True).record
    (error,) = [
        each["held_out_mae"]
        for each in record["auto"]["tried"]
        if each.get("network") == "tiny" and not each["iterations"] and each["propagate"] == "none"
    ]
    assert record["linear"]["folds"]["before"] == error
    (note,) = [note for note in record["notes"] if note.startswith("choice: ")]
    assert f"network {error:.4f}" in note


@pytest.mark.parametrize(
    ("propagation", "tried"), [(None, {"none", "gp"}), ("gp", {"none", "gp"}),
                         ("none", {"none"})],
)  # fmt: skip
def test_with_auto_only_the_propagation_that_is_asked_for_competes(
    frame: FrameOnDisk, propagation: str | None, tried: set[str]
) -> None:
    record = run(frame, auto=True, propagate=propagation).record
    assert {each.get("propagate", "none") for each in record["auto"]["tried"]} == tried
    assert record["settings"]["propagate"] == propagation


def test_the_record_has_the_choice_and_every_candidate(frame: FrameOnDisk) -> None:
    record = run(frame, auto=True, gt=frame.gt).record
    choice = record["auto"]
    assert abs(sum(each["weight"] for each in choice["chosen"]) - 1) < 1e-9
    errors = [each["held_out_mae"] for each in choice["tried"]]
    assert errors == sorted(errors)
    limit = min(each["held_out_mae"] for each in choice["tried"] if "baseline" in each)
    assert choice["held_out_mae"] <= limit + 1e-6
    assert choice["held_out_points"] == 60
    assert any(note.startswith("choice: ") for note in record["notes"])
    saved = json.loads((frame.folder / "out" / "img.json").read_text())
    assert saved["auto"] == json.loads(json.dumps(choice))


def test_without_options_of_the_method_it_is_chosen_by_held_out_points(
    frame: FrameOnDisk,
) -> None:
    record = run(frame, propagate=None).record
    assert record["method"] == {
        "kind": "chosen",
        "why": "default",
        "networks": ["tiny", "compact"],
    }
    assert record["auto"]["folds"] > 0


@pytest.mark.parametrize(
    ("options", "why"),
    [
        ({"iterations": 2}, "--iterations"),
        ({"layer": "encode"}, "--layer"),
        ({"preset": "fast"}, "--preset fast"),
        ({"preset": "paper", "iterations": 2}, "--preset paper --iterations"),
    ],
)
def test_an_option_of_the_method_fixes_it(
    frame: FrameOnDisk, options: dict[str, Any], why: str
) -> None:
    record = run(frame, **({"propagate": None} | options)).record
    assert record["method"] == {"kind": "fixed", "why": why, "networks": ["tiny"]}
    assert record["auto"] is None
    settings = record["settings"]
    assert {name: settings[name] for name in options if name != "preset"} == {
        name: value for name, value in options.items() if name != "preset"
    }


def test_the_papers_preset_is_the_papers_setting_bit_for_bit(frame: FrameOnDisk) -> None:
    paper = {
        "layer": "middle", "update": "sign", "lr": "0.01", "iterations": 5, "loss": "l1",
        "schedule": "constant", "blur": 0.0, "align": "none", "propagate": "none",
    }  # fmt: skip
    one = run(frame, preset="paper", format="npy", output=frame.folder / "preset")
    other = run(frame, **paper, format="npy", output=frame.folder / "options")
    depths = [
        (frame.folder / name / "img_depth.npy").read_bytes() for name in ("preset", "options")
    ]
    assert depths[0] == depths[1]
    assert one.record["settings"] == other.record["settings"]
    assert one.record["loss"] == other.record["loss"]


def test_networks_that_are_given_compete(frame: FrameOnDisk) -> None:
    second = frame.folder / "second.py"
    text = frame.model.read_text().replace('name="tiny"', 'name="second", complete=True')
    second.write_text(text)
    record = run(frame, propagate=None, more_models=(str(second),)).record
    assert record["method"]["networks"] == ["tiny", "second", "compact"]
    tried = {each.get("network") for each in record["auto"]["tried"]}
    assert {"tiny", "second", "compact"} <= tried


def test_linear_interpolation_is_beside_every_result(frame: FrameOnDisk) -> None:
    compared = run(frame, gt=frame.gt).record["linear"]
    assert compared["scores"]["mae"] < 0.05
    assert compared["worse"] is True
    compared = run(frame, output=frame.folder / "b").record["linear"]
    assert compared["scores"] is None
    assert compared["folds"]["after"] > compared["folds"]["linear"] > 0
    assert compared["worse"] is True
    compared = run(frame, output=frame.folder / "c", holdout=0.2).record["linear"]
    assert compared["held_out_error"]["mae"] > 0
    compared = run(frame, output=frame.folder / "d", propagate=None, gt=frame.gt).record["linear"]
    assert compared["worse"] is False


def test_the_same_request_gives_the_same_bytes(frame: FrameOnDisk) -> None:
    run(frame, auto=True, uncertainty=True, output=frame.folder / "a")
    run(frame, auto=True, uncertainty=True, output=frame.folder / "b")
    for name in ("img_depth.png", "img_sigma.exr"):
        assert (frame.folder / "a" / name).read_bytes() == (frame.folder / "b" / name).read_bytes()


def test_baselines_are_scored_at_held_out_points_and_against_the_truth(frame: FrameOnDisk) -> None:
    baselines = run(frame, baselines=True, gt=frame.gt).record["baselines"]
    assert set(baselines) == {*BASELINES, "network", "result"}
    for row in baselines.values():
        assert row["held_out_mae"] > 0
        assert row["scores"]["mae"] > 0
    plain = run(frame, gt=frame.gt, output=frame.folder / "plain").record["scores"]
    assert baselines["result"]["scores"]["mae"] == plain["after"]["mae"]  # nothing else has changed
    assert baselines["network"]["scores"]["mae"] == plain["before"]["mae"]


def test_the_standard_deviation_is_positive_and_in_a_file_of_its_own(frame: FrameOnDisk) -> None:
    record = run(frame, uncertainty=True).record
    sigma = read_depth(Path(record["outputs"]["sigma"])).values
    assert sigma.shape == frame.depth.shape
    assert (sigma > 0).all()
    valid = cv2.imread(record["outputs"]["valid"], cv2.IMREAD_UNCHANGED)
    assert valid.shape == frame.depth.shape
    assert set(np.unique(valid)) <= {0, 255}
    assert (frame.folder / "out" / "img_sigma_preview.png").is_file()
    with pytest.raises(UsageError, match="--uncertainty writes a second file"):
        run(frame, uncertainty=True, output=frame.folder / "depth.exr")


def test_propagation_follows_refinement(frame: FrameOnDisk) -> None:
    plain = run(frame, format="npy", output=frame.folder / "plain")
    spread = run(frame, format="npy", output=frame.folder / "gp", propagate="gp")
    errors = [each.record["sparse_error"]["after"]["mae"] for each in (plain, spread)]
    assert errors[1] < errors[0]


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
