"""The default method, --baselines, --uncertainty and --propagate of `pnpdepth refine`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pnpdepth_cli.choices import BASELINES
from pnpdepth_cli.errors import UsageError
from pnpdepth_cli.io.depth import read_depth
from tests.commands.frames import FrameOnDisk, run


def test_the_papers_method_is_the_papers_setting_bit_for_bit(frame: FrameOnDisk) -> None:
    paper = {
        "layer": "middle", "update": "sign", "lr": "0.01", "iterations": 5, "loss": "l1",
        "schedule": "constant", "blur": 0.0, "align": "none", "propagate": "none",
    }  # fmt: skip
    one, other = (frame.folder / name for name in ("method.npy", "options.npy"))
    by_name = run(frame, method="paper", output=one)
    by_options = run(frame, **paper, output=other)
    assert one.read_bytes() == other.read_bytes()
    assert by_name.settings == by_options.settings | {"method": "paper"}


def test_networks_that_are_given_are_fused(frame: FrameOnDisk) -> None:
    second = frame.folder / "second.py"
    text = frame.model.read_text().replace('name="tiny"', 'name="second", complete=True')
    second.write_text(text)
    request = {"propagate": None, "more_models": (str(second),), "output": frame.folder / "two"}
    record = run(frame, **request)
    assert record.method is not None
    assert record.method.networks == ["tiny", "second", "compact"]
    with pytest.raises(UsageError, match="several networks are fused"):
        run(frame, **(request | {"propagate": "none", "overwrite": True}))


@pytest.mark.parametrize("propagate", [None, "none"])
def test_baselines_are_scored_at_validation_points_and_against_the_truth(
    frame: FrameOnDisk, propagate: str | None
) -> None:
    errors = run(frame, baselines=True, gt=frame.gt, propagate=propagate).errors
    plain = run(frame, gt=frame.gt, propagate=propagate, output=frame.folder / "plain").errors
    for basis in ("ground_truth", "validation"):
        assert {*BASELINES, "before", "after"} <= errors[basis].keys()
    assert plain["ground_truth"].items() <= errors["ground_truth"].items()
    if propagate is None:  # the fixed method checks itself only for baselines
        assert plain["validation"].items() <= errors["validation"].items()


def test_the_standard_deviation_is_positive_and_rounded_in_a_png(frame: FrameOnDisk) -> None:
    sigma, exact = (
        read_depth(Path(refined.outputs["sigma"])).values
        for refined in (
            run(frame, uncertainty=True, propagate=None, format=name, output=frame.folder / name)
            for name in ("png", "npy")
        )
    )
    assert sigma.shape == frame.depth.shape
    assert (sigma > 0).all()
    assert np.abs(exact - sigma).max() < 0.00051
