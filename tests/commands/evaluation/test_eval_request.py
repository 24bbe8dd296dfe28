"""What the published protocols cut out, and which changes of them make sense."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from pnpdepth_cli.commands.evaluation.eval_request import EvalRequest
from pnpdepth_cli.commands.evaluation.scoring import crop_window
from pnpdepth_cli.errors import SizeError, UsageError
from pnpdepth_cli.protocols import find_protocol

# (protocol, frame, (top, bottom, left, right)) as the published evaluations cut them
WINDOWS = [
    ("paper", (228, 304), (0, 228, 0, 304)),
    ("nyu-eigen", (480, 640), (45, 471, 41, 601)),
    ("garg", (375, 1242), (153, 371, 44, 1197)),
    ("eigen", (375, 1242), (124, 342, 44, 1197)),
]


@pytest.mark.parametrize(("name", "size", "window"), WINDOWS)
def test_a_protocol_scores_the_window_that_was_published(
    name: str, size: tuple[int, int], window: tuple[int, int, int, int]
) -> None:
    top, bottom, left, right = window
    crop = find_protocol(name).crop
    assert crop_window(crop, size) == (slice(top, bottom), slice(left, right))


def test_a_crop_that_does_not_fit_the_frame_is_refused() -> None:
    with pytest.raises(SizeError, match=r"640×480 but this one is 304×228"):
        crop_window("nyu", (228, 304))


def request(name: str, **changes: Any) -> EvalRequest:
    return EvalRequest(prediction=Path(), ground_truth=Path(), protocol=name, **changes)


REFUSED: list[tuple[str, dict[str, Any], str]] = [
    ("papre", {}, "paper, whole"),
    ("eigen", {"max_depth": 0.0}, "--max-depth"),
    ("paper", {"max_depth": float("nan")}, "--max-depth"),
    ("paper", {"delta": 1.0}, "--delta"),
    ("paper", {"gt_scale": 0.0}, "--gt-scale"),
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
