"""The table of `--baselines`: every baseline beside the network and the result."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import torch
from torch import Tensor

from pnpdepth_cli.choices import BASELINES
from pnpdepth_cli.core.metrics import score
from pnpdepth_cli.errors import ModelError
from pnpdepth_cli.frames.default import ALIGNED, RESULT
from pnpdepth_cli.frames.frame import Check, DepthMap, RefinedFrame


def baseline_scores(frame: RefinedFrame, gt: DepthMap | None) -> dict[str, dict[str, Any]]:
    """Returns the scores of every baseline, of the network and of the result, by name.

    Each has the MAE at the hidden points and, with ground truth, all metrics. A baseline that
    fails on the frame is left out.

    Args:
        frame: The refined frame, with its check where there are enough points.
        gt: (H, W) metres, 0 = unknown. None without ground truth.
    """
    truth = None if gt is None else torch.from_numpy(gt)
    before, after = torch.from_numpy(frame.before), torch.from_numpy(frame.after)
    check, scores = frame.check, dict[str, dict[str, Any]]()
    for name, baseline in BASELINES.items():
        try:
            error = None if check is None else _hidden_error(check, name)
            dense = None if truth is None else baseline.depth(frame.used, before)
        except ModelError:  # such as a line through points that are all equally far
            continue
        scores[name] = _scores(error, dense, truth)
    of_network, of_result = (
        None if check is None else check.error(name) for name in (ALIGNED, RESULT)
    )
    scores["network"] = _scores(of_network, before, truth)
    scores["result"] = _scores(of_result, after, truth)
    return scores


def _hidden_error(check: Check, name: str) -> float:
    predicted = BASELINES[name].at(check.hidden.xy, check.kept, check.network)
    return check.with_prediction(name, predicted).error(name)


def _scores(error: float | None, dense: Tensor | None, truth: Tensor | None) -> dict[str, Any]:
    metrics = None if truth is None or dense is None else asdict(score(dense, truth))
    return {"held_out_mae": error, "scores": metrics}
