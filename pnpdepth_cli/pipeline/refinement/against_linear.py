"""A refined frame beside linear interpolation of the same points."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import torch

from pnpdepth_cli.completion.interpolation import linear
from pnpdepth_cli.core.metrics import score
from pnpdepth_cli.frames.default import LINEAR, RESULT
from pnpdepth_cli.frames.frame import DepthMap, RefinedFrame
from pnpdepth_cli.pipeline.refinement.points import point_error


def compared_with_linear(frame: RefinedFrame, gt: DepthMap | None) -> dict[str, Any]:
    """Returns the errors of linear interpolation where the result is scored, for a record.

    Args:
        frame: The refined frame.
        gt: (H, W) metres, 0 = unknown. None without ground truth.

    Returns:
        "scores" on the pixels of the ground truth where the result is known, "held_out_error" at
        the points of `--holdout`, and "check", the MAE of each stage at the hidden points; each
        None without such pixels or points. "worse": whether the MAE of the result is above that of
        linear interpolation, by the first of these that there is; None without any.
    """
    compared: dict[str, Any] = {"scores": None, "held_out_error": None, "check": None}
    worse: list[bool] = []
    dense = None
    if gt is not None or len(frame.held_out):
        dense = linear(frame.used)
    if gt is not None and dense is not None:
        after = torch.from_numpy(frame.after)
        truth = torch.where(after > 0, torch.from_numpy(gt), 0.0)
        own = score(dense, truth)
        compared["scores"] = asdict(own)
        worse.append(score(after, truth).mae > own.mae)
    if len(frame.held_out) and dense is not None:
        error = point_error(dense.numpy(), frame.held_out)
        result = point_error(frame.after, frame.held_out)
        if error is not None and result is not None:
            compared["held_out_error"] = asdict(error)
            worse.append(result.mae > error.mae)
    if frame.check is not None:
        check = frame.check
        errors = {name: check.error(name) for name in check.predicted}
        compared["check"] = {"points": len(check.hidden), **errors}
        worse.append(errors[RESULT] > errors[LINEAR])
    return compared | {"worse": worse[0] if worse else None}
