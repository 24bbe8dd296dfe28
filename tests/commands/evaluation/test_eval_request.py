"""Which changes of protocols make sense, and which score alike."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from pnpdepth_cli.commands.evaluation.eval_request import EvalRequest
from pnpdepth_cli.errors import UsageError


def request(name: str, **changes: Any) -> EvalRequest:
    return EvalRequest(prediction=Path(), ground_truth=Path(), protocol=name, **changes)


REFUSED: list[tuple[str, dict[str, Any], str]] = [
    ("papre", {}, "paper, whole"),
    ("eigen", {"max_depth": 0.0}, "--max-depth"),
    ("paper", {"delta": 1.0}, "--delta"),
    ("paper", {"pred_scale": float("nan")}, "--pred-scale"),
    ("paper", {"columns": ("rmse", "boundary")}, "boundary"),
    ("paper", {"depth_limits": (2.0, 1.0)}, "--by-depth"),
    ("kitti-devkit", {"delta": 1.01}, "kitti-devkit"),
    ("kitti-devkit", {"depth_limits": (1.0, 2.0)}, "kitti-devkit"),
    ("kitti-devkit", {"columns": ("boundary_f1",)}, "abs_relative"),
]


@pytest.mark.parametrize(("name", "changes", "named"), REFUSED)
def test_a_setting_without_sense_is_refused(name: str, changes: dict[str, Any], named: str) -> None:
    with pytest.raises(UsageError, match=named):
        request(name, **changes)


def test_rules_that_score_alike_are_equal_whatever_they_are_called() -> None:
    assert request("paper").scoring == request("kitti", resize=True).scoring
    kinds = ("paper", "nyu-eigen", "kitti-devkit", "eigen", "garg")
    asked = [*map(request, kinds), request("paper", exclude_sparse=True)]
    rules = [each.scoring for each in (*asked, request("paper", scale_by="median"))]
    assert all(a != b for i, a in enumerate(rules) for b in rules[:i])
