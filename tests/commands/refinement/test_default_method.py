"""The default method, --baselines, --uncertainty and --propagate of `pnpdepth refine`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from pnpdepth_cli.choices import BASELINES
from pnpdepth_cli.commands.refinement.inputs import read_inputs
from pnpdepth_cli.commands.refinement.refine import load_refiner
from pnpdepth_cli.commands.refinement.request import RefineRequest
from pnpdepth_cli.errors import UsageError
from pnpdepth_cli.frames.refiner import HIDDEN_POINT_STEPS
from pnpdepth_cli.io.depth import read_depth
from tests.commands.frames import FrameOnDisk, run


def test_without_options_of_the_method_it_is_the_default_one(frame: FrameOnDisk) -> None:
    record = run(frame, propagate=None, gt=frame.gt).record
    assert record["method"] == {
        "kind": "default",
        "reason": "default",
        "networks": ["tiny", "compact"],
    }
    stages = [stage["stage"] for stage in record["stages"]]
    assert stages == ["aligned", "fused", "updated", "propagated"]
    errors = [stage["scores"]["mae"] for stage in record["stages"]]
    assert errors[0] == record["scores"]["before"]["mae"]
    assert record["scores"]["after"]["mae"] < errors[0]
    check = record["linear"]["check"]
    assert check["points"] == 12
    assert set(check) == {"points", "aligned", "fused", "propagated", "linear", "result"}
    saved = json.loads((frame.folder / "out" / "img.json").read_text())
    assert saved["linear"] == json.loads(json.dumps(record["linear"]))


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({"iterations": 2}, "--iterations"),
        ({"layer": "encode"}, "--layer"),
        ({"preset": "paper"}, "--preset paper"),
        ({"preset": "paper", "iterations": 2}, "--preset paper --iterations"),
    ],
)
def test_an_option_of_the_method_fixes_it(
    frame: FrameOnDisk, options: dict[str, Any], reason: str
) -> None:
    record = run(frame, **({"propagate": None} | options)).record
    assert record["method"] == {"kind": "fixed", "reason": reason, "networks": ["tiny"]}
    assert record["stages"] is None
    assert record["linear"]["check"] is None
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
    assert one.record["settings"] == other.record["settings"] | {"preset": "paper"}
    assert one.record["loss"] == other.record["loss"]


def test_networks_that_are_given_are_fused(frame: FrameOnDisk) -> None:
    second = frame.folder / "second.py"
    text = frame.model.read_text().replace('name="tiny"', 'name="second", complete=True')
    second.write_text(text)
    request = {"propagate": None, "format": "npy", "more_models": (str(second),)}
    record = run(frame, **request, output=frame.folder / "two").record
    assert record["method"]["networks"] == ["tiny", "second", "compact"]
    with pytest.raises(UsageError, match="several --model are fused"):
        run(frame, **(request | {"propagate": "none"}))


def test_linear_interpolation_is_beside_every_result(frame: FrameOnDisk) -> None:
    compared = run(frame, gt=frame.gt).record["linear"]
    assert compared["scores"]["mae"] < 0.05
    assert compared["worse"] is True
    compared = run(frame, output=frame.folder / "b").record["linear"]
    assert compared == {"scores": None, "held_out_error": None, "check": None, "worse": None}
    compared = run(frame, output=frame.folder / "c", holdout=0.2).record["linear"]
    assert compared["held_out_error"]["mae"] > 0
    assert compared["worse"] is True


def test_the_same_request_gives_the_same_bytes(frame: FrameOnDisk) -> None:
    for name in ("a", "b"):
        run(frame, propagate=None, uncertainty=True, output=frame.folder / name)
    for name in ("img_depth.png", "img_sigma.exr"):
        assert (frame.folder / "a" / name).read_bytes() == (frame.folder / "b" / name).read_bytes()


@pytest.mark.parametrize("propagate", [None, "none"])
def test_baselines_are_scored_at_hidden_points_and_against_the_truth(
    frame: FrameOnDisk, propagate: str | None
) -> None:
    with_table = run(frame, baselines=True, gt=frame.gt, propagate=propagate).record
    baselines = with_table["baselines"]
    assert set(baselines) == {*BASELINES, "network", "result"}
    check = with_table["linear"]["check"]
    assert baselines["linear"]["held_out_mae"] == pytest.approx(check["linear"], rel=1e-6)
    assert baselines["result"]["held_out_mae"] == check["result"]
    assert baselines["network"]["held_out_mae"] == check["aligned"]
    assert baselines["linear"]["scores"]["mae"] == with_table["linear"]["scores"]["mae"]
    plain = run(frame, gt=frame.gt, propagate=propagate, output=frame.folder / "plain").record
    assert baselines["result"]["scores"]["mae"] == plain["scores"]["after"]["mae"]
    assert baselines["network"]["scores"]["mae"] == plain["scores"]["before"]["mae"]


def test_the_standard_deviation_is_positive_and_in_a_file_of_its_own(frame: FrameOnDisk) -> None:
    record = run(frame, uncertainty=True).record
    sigma = read_depth(Path(record["outputs"]["sigma"])).values
    assert sigma.shape == frame.depth.shape
    assert (sigma > 0).all()
    valid = cv2.imread(record["outputs"]["valid"], cv2.IMREAD_UNCHANGED)
    assert valid.shape == frame.depth.shape
    assert set(np.unique(valid)) <= {0, 255}
    assert (frame.folder / "out" / "img_sigma_preview.png").is_file()
    assert any("calibrated with 12 hidden points" in note for note in record["notes"])
    with pytest.raises(UsageError, match="--uncertainty writes a second file"):
        run(frame, uncertainty=True, output=frame.folder / "depth.exr")


def test_propagation_follows_refinement(frame: FrameOnDisk) -> None:
    plain = run(frame, format="npy", output=frame.folder / "plain")
    spread = run(frame, format="npy", output=frame.folder / "gp", propagate="gp")
    errors = [outcome.record["sparse_error"]["after"]["mae"] for outcome in (plain, spread)]
    assert errors[1] < errors[0]


def test_a_time_budget_is_spent_on_steps_by_hidden_points(frame: FrameOnDisk) -> None:
    for budget_s, steps in ((1e-9, None), (1e6, {"compact": 1})):
        record = run(frame, propagate=None, time_budget_s=budget_s, overwrite=True).record
        made = record["hidden_point_steps"]
        assert (made is None) == (steps is None)
        if made is not None:
            assert made.keys() == {"compact"}
            assert 0 <= made["compact"] <= HIDDEN_POINT_STEPS
    with pytest.raises(UsageError, match="--time-budget caps steps by hidden points"):
        run(frame, time_budget_s=1.0, overwrite=True)


def test_networks_of_the_default_method_are_aligned_and_updated_a_few_times(
    frame: FrameOnDisk,
) -> None:
    request = RefineRequest.from_fields(
        image=frame.image,
        sparse=frame.sparse,
        model=str(frame.model),
        checkpoint=frame.checkpoint,
        time_budget_s=5.0,
    )
    user, compact = load_refiner(request, read_inputs(request)).members
    assert (user.settings.align, user.settings.iterations) == ("auto", 5)
    assert user.hidden_points is None
    assert (compact.settings.align, compact.settings.iterations) == ("none", 2)
    assert compact.hidden_points is not None
    assert compact.hidden_points.masked
