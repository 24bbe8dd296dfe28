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
    networks = ["tiny", "compact"]
    assert record["method"] == {"kind": "default", "reason": "default", "networks": networks}
    stages = {stage["stage"]: stage["scores"]["mae"] for stage in record["stages"]}
    assert list(stages) == ["aligned", "fused", "updated", "propagated"]
    assert stages["aligned"] == record["scores"]["before"]["mae"]
    assert record["scores"]["after"]["mae"] < stages["aligned"]
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
        ({"preset": "paper", "iterations": 2}, "--preset paper --iterations"),
    ],
)
def test_an_option_of_the_method_fixes_it(
    frame: FrameOnDisk, options: dict[str, Any], reason: str
) -> None:
    record = run(frame, **({"propagate": None} | options)).record
    assert record["method"] == {"kind": "fixed", "reason": reason, "networks": ["tiny"]}
    assert (record["stages"], record["linear"]["check"]) == (None, None)
    assert record["settings"] == record["settings"] | options


def test_the_papers_preset_is_the_papers_setting_bit_for_bit(frame: FrameOnDisk) -> None:
    paper = {
        "layer": "middle", "update": "sign", "lr": "0.01", "iterations": 5, "loss": "l1",
        "schedule": "constant", "blur": 0.0, "align": "none", "propagate": "none",
    }  # fmt: skip
    one, other = (frame.folder / name for name in ("preset.npy", "options.npy"))
    by_name = run(frame, preset="paper", output=one).record
    by_options = run(frame, **paper, output=other).record
    assert one.read_bytes() == other.read_bytes()
    assert by_name["settings"] == by_options["settings"] | {"preset": "paper"}


def test_networks_that_are_given_are_fused(frame: FrameOnDisk) -> None:
    second = frame.folder / "second.py"
    text = frame.model.read_text().replace('name="tiny"', 'name="second", complete=True')
    second.write_text(text)
    request = {"propagate": None, "more_models": (str(second),), "output": frame.folder / "two"}
    record = run(frame, **request).record
    assert record["method"]["networks"] == ["tiny", "second", "compact"]
    with pytest.raises(UsageError, match="several --model are fused"):
        run(frame, **(request | {"propagate": "none", "overwrite": True}))


def test_linear_interpolation_is_beside_every_result(frame: FrameOnDisk) -> None:
    compared = run(frame, gt=frame.gt).record["linear"]
    assert compared["scores"]["mae"] < 0.05
    assert compared["worse"] is True
    compared = run(frame, output=frame.folder / "b").record["linear"]
    assert compared == {"scores": None, "held_out_error": None, "check": None, "worse": None}
    compared = run(frame, output=frame.folder / "c", holdout=0.2).record["linear"]
    assert 0 < compared["held_out_error"]["mae"] < 0.5
    assert compared["worse"] is True


@pytest.mark.parametrize("propagate", [None, "none"])
def test_baselines_are_scored_at_hidden_points_and_against_the_truth(
    frame: FrameOnDisk, propagate: str | None
) -> None:
    record = run(frame, baselines=True, gt=frame.gt, propagate=propagate).record
    baselines, check = record["baselines"], record["linear"]["check"]
    assert set(baselines) == {*BASELINES, "network", "result"}
    assert baselines["linear"]["held_out_mae"] == pytest.approx(check["linear"], rel=1e-6)
    assert baselines["result"]["held_out_mae"] == check["result"]
    assert baselines["network"]["held_out_mae"] == check["aligned"]
    assert baselines["linear"]["scores"]["mae"] == record["linear"]["scores"]["mae"]
    plain = run(frame, gt=frame.gt, propagate=propagate, output=frame.folder / "plain").record
    assert baselines["result"]["scores"] == plain["scores"]["after"]
    assert baselines["network"]["scores"] == plain["scores"]["before"]


def test_the_standard_deviation_is_positive_and_the_same_twice(frame: FrameOnDisk) -> None:
    records = [
        run(frame, uncertainty=True, propagate=None, output=frame.folder / name).record
        for name in ("a", "b")
    ]
    outputs = records[0]["outputs"]
    sigma = read_depth(Path(outputs["sigma"])).values
    valid = cv2.imread(outputs["valid"], cv2.IMREAD_UNCHANGED)
    assert sigma.shape == valid.shape == frame.depth.shape
    assert (sigma > 0).all()
    assert set(np.unique(valid)) <= {0, 255}
    exact = run(frame, uncertainty=True, propagate=None, format="npy", output=frame.folder / "c")
    assert np.abs(np.load(exact.record["outputs"]["sigma"]) - sigma).max() < 0.00051
    assert any("calibrated with 12 hidden points" in note for note in records[0]["notes"])
    for name in ("img_depth.png", "img_sigma.png", "img_sigma_preview.png"):
        first, again = (frame.folder / folder / name for folder in ("a", "b"))
        assert first.read_bytes() == again.read_bytes()
    with pytest.raises(UsageError, match="--uncertainty writes a second file"):
        run(frame, uncertainty=True, output=frame.folder / "depth.exr")


def test_propagation_follows_refinement(frame: FrameOnDisk) -> None:
    errors = [
        run(frame, propagate=name, output=frame.folder / name).record["sparse_error"]["after"]
        for name in ("gp", "none")
    ]
    assert errors[0]["mae"] < errors[1]["mae"]


def test_a_time_budget_is_spent_on_steps_by_hidden_points(frame: FrameOnDisk) -> None:
    record = run(frame, propagate=None, time_budget_s=1e-9).record
    assert record["hidden_point_steps"] is None
    record = run(frame, propagate=None, time_budget_s=1e6, overwrite=True).record
    assert record["hidden_point_steps"].keys() == {"compact"}
    assert 0 <= record["hidden_point_steps"]["compact"] <= HIDDEN_POINT_STEPS


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
